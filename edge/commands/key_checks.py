# SPDX-License-Identifier: Apache-2.0
"""The doctor's look at the CURVE keys: there where a rig wants them, whose they are, closed to others, a real pair."""

from __future__ import annotations

from pathlib import Path

from edge.commands.checks import Check
from edge.config import StreamSettings
from edge.errors import ConfigError
from edge.stream.addresses import is_local
from edge.stream.keys import DEFAULT_FOLDER, KeyFolder

NAME = "keys"
AS_THE_SERVICE = "sudo -u rfconstruct rfconstruct doctor"


def keys_check(stream: StreamSettings | None, default: Path = DEFAULT_FOLDER) -> Check:
    """What there is to say about the appliance's keys.

    Args:
        stream: settings of a rig; None: no rig is named, and the usual folder is looked at if there is one.
        default: the usual folder.
    Returns:
        "fails" when a publisher with these settings would refuse to start or would let nobody in.
    """
    given = stream.key_folder if stream is not None else ""
    addresses = (*stream.endpoints, *stream.latest_endpoints) if stream is not None else ()
    remote = [address for address in addresses if not is_local(address)]
    try:
        if not given and remote:
            action = "rfconstruct keys init, then set stream.key_folder"
            return Check(NAME, "fails", f"none configured, and other machines reach {', '.join(remote)}", action)
        if not given and (stream is not None or not default.is_dir()):
            return Check(NAME, "ok", "none configured: only this machine may subscribe")
        return _folder_check(KeyFolder(Path(given) if given else default))
    except PermissionError as error:
        action = f"look as the service: {AS_THE_SERVICE}"
        return Check(NAME, "note", f"{error.filename}: not to be read by this user", action)
    except ConfigError as error:
        return Check(NAME, "fails", error.what, error.action)


def _folder_check(folder: KeyFolder) -> Check:
    problems = list(folder.problems())
    if problems:
        action = f"rfconstruct keys init --folder {folder.path}" if not folder.path.is_dir() else _mend(folder)
        return Check(NAME, "fails", "; ".join(problems), action)
    clients = folder.names()
    if not clients:
        return Check(NAME, "note", f"{folder.path}: in order, and nobody is let in", "rfconstruct keys client NAME")
    return Check(NAME, "ok", f"{folder.path}: in order, let in: {', '.join(clients)}")


def _mend(folder: KeyFolder) -> str:
    modes = "folders 0700, secrets 0600, all of the service's user"
    return f"make keys anew (rfconstruct keys init), or mend {folder.path}: {modes}"
