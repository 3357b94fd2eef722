# SPDX-License-Identifier: Apache-2.0
"""What every subscribing verb shares: the address, the keys it needs beyond this machine, and why nobody lets it in."""

from __future__ import annotations

import argparse
from pathlib import Path

from edge.errors import ConfigError
from edge.stream.addresses import is_local
from edge.stream.client import DEFAULT_ENDPOINT, Client
from edge.stream.keys import SECRET


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Address and keys."""
    parser.add_argument("--endpoint", default=DEFAULT_ENDPOINT, help="address of the publisher (default: %(default)s)")
    parser.add_argument("--keys", type=Path, metavar="FILE", help=f"NAME{SECRET}, for an appliance on another machine")


def require_keys(endpoint: str, keys: Path | str | None) -> None:
    """ConfigError when the address is another machine's and there are no keys: nothing would ever come.

    Args:
        endpoint: of the publisher; what is no address at all is left to the client to refuse.
        keys: of the client, or None.
    """
    if keys is not None or not endpoint.startswith("tcp://") or endpoint == "tcp://" or is_local(endpoint):
        return
    raise ConfigError(
        "an appliance lets other machines in only with keys",
        value=endpoint,
        allowed=f"--keys NAME{SECRET}; without keys: this machine, or an SSH tunnel to it",
        action="rfconstruct keys client NAME on the appliance makes the file",
    )


def why_refused(client: Client) -> str:
    """Why nothing comes, as far as a client can know, when the publisher refuses it; empty: it does not."""
    if not client.refused:
        return ""
    if client.keys is None:
        return f"{client.endpoint} refuses this client: it wants keys (--keys NAME{SECRET})"
    return (
        f"{client.endpoint} refuses {client.keys}: the client is not let in (rfconstruct keys list there), "
        "the keys are another appliance's, or the address is one without keys"
    )
