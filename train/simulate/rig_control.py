# SPDX-License-Identifier: Apache-2.0
"""Control socket of the virtual rig: one line of text an order, answered by lines that end with ``ok`` or ``error``.

    set drop vertical/data share=0.01 times=5 skip=100 value=1
    clear [FAULT] [WHERE]
    list | struck | violations | late | addresses
    unplug horizontal|vertical|pose [silent]
    plug horizontal|vertical|pose
    pulse horizontal|vertical
    target vertical 127.0.0.1:4099
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from edge.errors import ConfigError, RfconstructError
from edge.frames import RADARS
from train.simulate.faults import Faults
from train.simulate.tcp_server import OneClientServer

if TYPE_CHECKING:
    from train.simulate.rig import VirtualRig

LONGEST_LINE = 1000
_NUMBERS: dict[str, Callable[[str], float]] = {"share": float, "times": int, "skip": int, "value": float}


class RigControl:
    """Takes orders for a rig.

    Args:
        rig: what is controlled.
        port: of 127.0.0.1; 0: any free one.
    """

    def __init__(self, rig: VirtualRig, port: int = 0) -> None:
        self._rig, self._rest = rig, b""
        self._server = OneClientServer("127.0.0.1", port, "rig control", self._session)
        self.address = self._server.address
        self.start, self.stop = self._server.start, self._server.stop

    def feed(self, data: bytes) -> bool:
        """Bytes of the client."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._server.send(self.answer(line.decode("utf-8", "replace").strip()).encode())
        return len(self._rest) <= LONGEST_LINE

    def answer(self, line: str) -> str:
        """Carry out one order; its answer, every line ended."""
        try:
            lines = self._obey(line.split())
        except (RfconstructError, ValueError, IndexError) as error:
            return f"error {error or 'an argument is missing'}\n".replace("\n", " ").rstrip() + "\n"
        return "".join(f"{text}\n" for text in [*lines, "ok"])

    def _session(self) -> RigControl:
        self._rest = b""
        return self

    def _obey(self, words: list[str]) -> list[str]:
        rig = self._rig
        name, arguments = (words[0], words[1:]) if words else ("", [])
        if name == "set":
            set_fault(rig.faults, arguments)
            return []
        if name == "clear":
            fault, where = [*arguments, None, None][:2]
            return [f"{rig.faults.clear(fault, where)} removed"]
        if name == "target":
            host, _, port = arguments[1].rpartition(":")
            for radar in RADARS:
                if radar == arguments[0] and radar in rig.cards:
                    rig.cards[radar].data_target = (host, int(port))
                    return []
            raise ConfigError("no such capture card", value=arguments[0], allowed=", ".join(rig.cards))
        if name in ("unplug", "plug", "pulse"):
            if name == "unplug":
                rig.unplug(arguments[0], "silent" in arguments[1:])
            elif name == "plug":
                rig.plug(arguments[0])
            else:
                rig.pulse(arguments[0])
            return []
        reports: dict[str, Callable[[], list[str]]] = {
            "list": rig.faults.rules,
            "struck": lambda: [f"{fault} {where} {n}" for (fault, where), n in sorted(rig.faults.struck.items()) if n],
            "violations": lambda: [f"{part} {text}" for part, texts in rig.violations().items() for text in texts],
            "late": lambda: [f"{radar} {count}" for radar, count in rig.late().items()],
            "addresses": lambda: [f"{part} {where}" for part, where in rig.addresses().items()],
        }
        if name not in reports:
            known = ", ".join(["set", "clear", "unplug", "plug", "pulse", "target", *reports])
            raise ConfigError("unknown order", value=name, allowed=known)
        return reports[name]()


def set_fault(faults: Faults, words: list[str]) -> None:
    """Add a rule from its words: FAULT WHERE key=value ...

    Raises:
        ConfigError: no rule.
    """
    if len(words) < 2:
        raise ConfigError("a fault needs a name and a channel", value=" ".join(words), allowed="drop vertical/data ...")
    numbers: dict[str, float] = {}
    for word in words[2:]:
        key, _, text = word.partition("=")
        try:
            numbers[key] = _NUMBERS[key](text)
        except (KeyError, ValueError) as error:
            raise ConfigError("no setting of a fault", value=word, allowed=", ".join(_NUMBERS)) from error
    faults.set(words[0], words[1], **numbers)  # type: ignore[arg-type]
