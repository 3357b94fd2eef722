# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct keys``: keys of the appliance and of the clients that may subscribe from other machines."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge.errors import ConfigError, ExitCode
from edge.stream.keys import (
    DEFAULT_FOLDER,
    PUBLIC,
    SECRET,
    SERVER,
    KeyFolder,
    create_client,
    read_certificate,
)

EXAMPLES = """actions:
  init              make the appliance's pair and the folder of its clients
  client NAME       make a client's pair and let the client in: give it NAME.key_secret, by a safe way
  client NAME --server FILE
                    the same on the client's machine, given the appliance's server.key; give the appliance NAME.key
  allow FILE        let in the client whose public key is in FILE (NAME.key)
  revoke NAME       refuse a client from its next connection on
  list              clients that are let in, and what is wrong with files or modes
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EXAMPLES
    parser.add_argument("action", choices=tuple(ACTIONS), help="see below")
    parser.add_argument("subject", nargs="?", default="", metavar="NAME|FILE", help="of the client")
    parser.add_argument(
        "--folder", type=Path, default=DEFAULT_FOLDER, help="the appliance's keys (default: %(default)s)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path(), metavar="DIR", help="where a client's files go (default: .)"
    )
    parser.add_argument("--server", type=Path, metavar="FILE", help="the appliance's public key, on a client's machine")


def run(args: argparse.Namespace) -> int:
    """Do it; exit code 3 when ``list`` finds something wrong."""
    if (args.subject != "") is not (args.action in ("client", "allow", "revoke")):
        print(f"rfconstruct keys: {args.action} takes {'no' if args.subject else 'a'} name or file", file=sys.stderr)
        return ExitCode.USAGE
    facts: dict[str, Any] = ACTIONS[args.action](args, KeyFolder(args.folder))
    if args.json:
        print(json.dumps({key: value for key, value in facts.items() if key != "text"}))
    else:
        print(facts["text"])
    return ExitCode.DEGRADED if facts.get("problems") else ExitCode.OK


def _init(args: argparse.Namespace, folder: KeyFolder) -> dict[str, Any]:
    public = folder.create().public.decode()
    text = f"keys of the appliance in {folder.path}\npublic key  {public}\nset stream.key_folder to this folder"
    return {"folder": str(folder.path), "public_key": public, "text": text}


def _client(args: argparse.Namespace, folder: KeyFolder) -> dict[str, Any]:
    server = read_certificate(args.server or folder.path / f"{SERVER}{PUBLIC}")
    if args.server is None and args.subject in folder.names():
        raise ConfigError("a client of this name is let in already", value=args.subject, action="revoke it first")
    public = create_client(args.subject, args.out, server.public).public
    secret = args.out / f"{args.subject}{SECRET}"
    if args.server is None:
        folder.allow(args.subject, public)
        text = f"{args.subject} is let in; give it {secret} by a safe way and keep no copy"
    else:
        public_file = args.out / f"{args.subject}{PUBLIC}"
        text = f"secret      {secret}\ngive the appliance {public_file}: rfconstruct keys allow FILE"
    return {"name": args.subject, "secret_file": str(secret), "public_key": public.decode(), "text": text}


def _allow(args: argparse.Namespace, folder: KeyFolder) -> dict[str, Any]:
    file = Path(args.subject)
    public, name = read_certificate(file).public, file.name.removesuffix(SECRET).removesuffix(PUBLIC)
    folder.allow(name, public)
    return {"name": name, "public_key": public.decode(), "text": f"{name} is let in"}


def _revoke(args: argparse.Namespace, folder: KeyFolder) -> dict[str, Any]:
    folder.revoke(args.subject)
    text = f"{args.subject} is refused from its next connection on; systemctl restart rfconstruct ends the present ones"
    return {"name": args.subject, "text": text}


def _list(args: argparse.Namespace, folder: KeyFolder) -> dict[str, Any]:
    problems = list(folder.problems())
    clients = {name: public.decode() for public, name in folder.allowed().items()}
    lines = [f"{name:<20}{public}" for name, public in sorted(clients.items())] or ["no client is let in"]
    return {"clients": clients, "problems": problems, "text": "\n".join([*lines, *problems])}


ACTIONS: dict[str, Callable[[argparse.Namespace, KeyFolder], dict[str, Any]]] = {
    "init": _init,
    "client": _client,
    "allow": _allow,
    "revoke": _revoke,
    "list": _list,
}
