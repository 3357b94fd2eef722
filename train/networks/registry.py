# SPDX-License-Identifier: Apache-2.0
"""Networks by name: ``queries``, ``narrow``, ``paper``, ``pcn`` and ``adapointr``, with their widths and options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from edge.config import require
from train.network import WIDTHS, CompletionModel, CompletionNetwork, Frame
from train.networks.adapointr import TRANSFORMER_WIDTHS, AdaPoinTr
from train.networks.narrow import NarrowNetwork, NarrowOptions
from train.networks.queries import QUERY_WIDTHS, QueryNetwork, QueryOptions
from train.objects.mesh import CLASSES

if TYPE_CHECKING:
    from train.checkpoint import Checkpoint

Option = bool | int | str


@dataclass(frozen=True, slots=True)
class Entry:
    """What can be chosen of one network.

    Args:
        widths: names.
        width: the default.
        options: name -> type.
        about: one line for the user.
    """

    widths: tuple[str, ...]
    width: str
    options: Mapping[str, type]
    about: str


_OPTIONS: dict[str, type] = {field.name: type(field.default) for field in fields(NarrowOptions)}
_QUERY_OPTIONS: dict[str, type] = {field.name: type(field.default) for field in fields(QueryOptions)}
NETWORKS = {
    "queries": Entry(tuple(QUERY_WIDTHS), "edge", _QUERY_OPTIONS, "transformer for the edge, queries from the input"),
    "narrow": Entry(tuple(WIDTHS), "edge", _OPTIONS, "the paper's, narrow, with the switches of --option"),
    "paper": Entry(tuple(WIDTHS), "paper", {}, "the paper's: local features, folding, classifier in training"),
    "pcn": Entry(tuple(WIDTHS), "paper", {}, "Point Completion Network: no local features, no classifier"),
    "adapointr": Entry(tuple(TRANSFORMER_WIDTHS), "full", {}, "transformer in the manner of AdaPoinTr"),
}


def parse_options(name: str, pairs: list[str]) -> dict[str, Option]:
    """``key=value`` texts as typed options of a network.

    Raises:
        ConfigError: no such network or option, or a value of another type.
    """
    require(name in NETWORKS, "network", name, ", ".join(NETWORKS))
    known, result = NETWORKS[name].options, {}
    for pair in pairs:
        key, _, text = pair.partition("=")
        require(key in known, f"option of network {name}", pair, ", ".join(f"{k}=..." for k in known) or "none")
        value: Option = text
        if known[key] is bool:
            require(text in ("true", "false"), f"option {key}", text, "true, false")
            value = text == "true"
        elif known[key] is int:
            require(text.isdecimal(), f"option {key}", text, "a whole number")
            value = int(text)
        result[key] = value
    return result


def build(
    name: str, width: str = "", frame: Frame = "sight", options: Mapping[str, Option] | None = None
) -> CompletionModel:
    """An untrained network.

    Args:
        name: key of ``NETWORKS``.
        width: one of its widths, "" for the usual one.
        frame: of the input.
        options: of the network.
    Raises:
        ConfigError: a name, width or option that there is not.
    """
    require(name in NETWORKS, "network", name, ", ".join(NETWORKS))
    entry, chosen = NETWORKS[name], dict(options or {})
    width = width or entry.width
    require(width in entry.widths, f"width of network {name}", width, ", ".join(entry.widths))
    unknown = sorted(set(chosen) - set(entry.options))
    require(not unknown, f"option of network {name}", unknown, ", ".join(entry.options) or "none")
    if name == "adapointr":
        return AdaPoinTr(TRANSFORMER_WIDTHS[width], frame)
    values: dict[str, Any] = chosen
    if name == "queries":
        return QueryNetwork(QUERY_WIDTHS[width], len(CLASSES), frame, QueryOptions(**values))
    if name == "narrow":
        return NarrowNetwork(WIDTHS[width], len(CLASSES), frame, NarrowOptions(**values))
    return CompletionNetwork(WIDTHS[width], len(CLASSES) if name == "paper" else 0, frame, local=name == "paper")


def of_checkpoint(checkpoint: Checkpoint) -> CompletionModel:
    """The trained network of a run, its averaged weights, ready to use on the CPU."""
    settings = checkpoint.settings
    network = build(settings["network"], settings["width"], settings.get("frame", "sight"), settings.get("options"))
    network.load_state_dict(checkpoint.average)
    return network.eval()
