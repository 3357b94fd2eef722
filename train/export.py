# SPDX-License-Identifier: Apache-2.0
"""Network to ONNX: the graph is built by hand, in the unit of the input, for any number of points and objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx

from edge.errors import ModelError
from edge.frames import Float32
from train.export_parts import Parts
from train.export_queries import QueryBuilder
from train.graph import per_object
from train.network import CompletionModel, CompletionNetwork
from train.networks.narrow import NarrowNetwork, NarrowOptions
from train.networks.queries import QueryNetwork
from train.quantize import with_saturation_probe

INT8_NODES = ("local1", "local2", "fold1_cells", "fold2", "fold3", "sigma_log", "group", "rebuild1", "rebuild2")
"""Nodes that compute on features of input points, neighbours, queries or fine points: fit for eight bits. Coordinates,
attention and layers of one row stay in float."""


def build(network: CompletionModel, classifier: bool = True) -> onnx.ModelProto:
    """A network as an ONNX graph for one object (opset 21).

    What does not differ per fine point is computed once per coarse point or once per cloud. Of all but ``queries``
    (``export_queries``) the graph computes in the unit of the input about its centre, so scale and centring cost
    nothing; the product of the folding's local weight and the encoder's last weight is a constant, and so is the patch
    term.

    Args:
        network: ``queries``, ``narrow``, ``paper`` or ``pcn`` of ``networks.registry``, with any options.
        classifier: whether the graph gives classes; the paper's network has its classifier in training only.
    Returns:
        Model with input ``points`` float32 [n, columns] metres, n >= 1 free, and outputs ``fine`` float32 [fine, 3] and
        ``coarse`` float32 [coarse, 3], in unit and frame of the input; with a classifier ``class_probability`` float32
        [classes]; with the option ``uncertainty``, and from ``queries``, ``sigma`` float32 [fine], expected distance of
        a fine point to the surface.
    Raises:
        ModelError: a network of another kind.
    """
    if isinstance(network, QueryNetwork):
        return QueryBuilder(network).model(classifier)
    if not isinstance(network, CompletionNetwork):
        raise ModelError(
            "this network has no edge graph",
            value=type(network).__name__,
            allowed="queries, narrow, paper, pcn",
            action="choose",
        )
    return _Builder(network).model(classifier and network.classes > 0)


def export(model: onnx.ModelProto, path: Path) -> None:
    """Write a model of one object, fp32 or quantized, as a file for any number of objects (``graph.per_object``)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = per_object(model)
    coded = any(node.op_type == "QGemm" for node in model.graph.node)
    onnx.save(with_saturation_probe(whole) if coded else whole, path)


class _Builder(Parts):
    """The layers of one network; method by method what ``network`` and ``networks.narrow`` compute."""

    network: CompletionNetwork

    def __init__(self, network: CompletionNetwork) -> None:
        super().__init__(network)
        plain = NarrowOptions(coarse=network.coarse_points)
        self.options = network.options if isinstance(network, NarrowNetwork) else plain
        self.channels, self.width = network.width.local[1], network.width.fold
        self.count, self.cells = network.coarse_points, network.cells

    def model(self, classifier: bool) -> onnx.ModelProto:
        """The whole graph."""
        graph, fine = self.graph, self.count * self.cells
        self._center()
        hidden, feature = self._encoder(self._inputs())
        graph.prepare_rows("centered")
        if self.options.attention in ("tokens", "both"):
            feature = graph.add("Add", [feature, self._probe(hidden, feature)], "feature_probed")
        coarse, base = self._folding_base(hidden, feature)
        graph.add("Add", [coarse, "center"], "coarse")
        last = self._folding(base)
        outputs: dict[str, tuple[int, ...]] = {"fine": (fine, 3), "coarse": (self.count, 3)}
        if classifier:
            graph.relu(self._layer("class1", feature))
            graph.add("Softmax", [self._layer("class2", "class1_relu")], "softmax", axis=1)
            graph.view("softmax", [self.network.classes], "class_probability")
            outputs["class_probability"] = (self.network.classes,)
        if self.options.uncertainty:
            bias = self.weights["sigma.bias"] + np.log(self.scale)
            graph.add("Exp", [graph.linear(last, self.weights["sigma.weight"], bias, "sigma_log")], "sigma_column")
            graph.view("sigma_column", [fine], "sigma")
            outputs["sigma"] = (fine,)
        return graph.model(outputs, self.network.columns)

    def _inputs(self) -> str:
        """Coordinates and what the options add, scaled in the first layer's weight."""
        from train.networks.narrow import GROUND_M, GROUND_WIDTH_M

        graph, columns = self.graph, ["centered"]
        if self.options.power:
            columns.append(graph.add("Slice", ["points", *(graph.integers(n) for n in (3, 4, 1))], "power_db"))
        if self.options.ground:
            height = graph.add("Slice", ["centered", *(graph.integers(n) for n in (2, 3, 1))], "height")
            factor = np.full((1, 1), -1 / GROUND_WIDTH_M, np.float32)
            graph.linear(height, factor, np.full(1, GROUND_M / GROUND_WIDTH_M, np.float32), "nearness")
            columns.append(graph.add("Sigmoid", ["nearness"], "ground"))
        return graph.add("Concat", columns, "inputs", axis=1) if len(columns) > 1 else columns[0]

    def _encoder(self, source: str) -> tuple[str, str]:
        """Hidden rows of the second PointNet layer [n, channels] and the global feature [1, channels]."""
        from train.networks.narrow import POWER_DB

        graph, weights = self.graph, self.weights
        lift = weights["point1.weight"] / np.array([self.scale] * 3 + [1.0] * (weights["point1.weight"].shape[1] - 3))
        if self.options.power:
            lift[:, 3] /= POWER_DB
        graph.relu(graph.linear(source, lift.astype(np.float32), weights["point1.bias"], "point1"))
        first = self._layer("point2", "point1_relu")
        graph.add("ReduceMax", [first, graph.integers(0)], "global1", keepdims=1)
        weight = weights["local1.weight"]
        split = weight.shape[1] // 2
        shared = graph.linear("global1", weight[:, split:], weights["local1.bias"], "local1_global")
        hidden = graph.relu(graph.linear(first, weight[:, :split], shared, "local1"))
        self._layer("local2", hidden)
        return hidden, graph.add("ReduceMax", ["local2", graph.integers(0)], "feature", keepdims=1)

    def _folding_base(self, hidden: str, feature: str) -> tuple[str, str]:
        """Coarse points about the centre, and what all cells of a coarse point share in the folding [coarse, fold]."""
        graph, weights = self.graph, self.weights
        weight, local = weights["fold1.weight"], self.network.local
        coarse, bias = self._coarse(feature), weights["fold1.bias"]
        of_coarse = weight[:, 2:5] / self.scale
        if not local:
            shared = graph.linear(feature, weight[:, -self.channels :], bias, "fold_global")
            return coarse, graph.linear(coarse, of_coarse, shared, "fold_coarse")
        of_local = weight[:, 5 : 5 + self.channels]
        bias = bias + of_local @ weights["local2.bias"]
        shared = graph.linear(feature, weight[:, -self.channels :], bias, "fold_global")
        rows = graph.nearest_rows(coarse, self.count, "nearest")
        found = graph.add("Gather", [hidden, rows], "local", axis=0)
        product = of_local @ weights["local2.weight"]
        extra = []
        if self.options.attention in ("coarse", "both"):
            own = graph.linear(found, product, None, "fold_local")
            context = self._look(coarse, own)
            moved = graph.linear(context, weights["coarse_move.weight"] * self.scale,
                                 weights["coarse_move.bias"] * self.scale, "coarse_step")  # fmt: skip
            coarse = graph.add("Add", [coarse, moved], "coarse_moved")
            base = graph.linear(coarse, of_coarse, shared, "fold_coarse")
            extra = [own, context]
        else:
            base = graph.linear(coarse, of_coarse, shared, "fold_coarse")
            base = graph.linear(found, product, base, "fold_local")
        if self.options.mirror == "cue":
            extra += self._cue(coarse, hidden, rows, feature)
        for number, term in enumerate(extra):
            base = graph.add("Add", [base, term], f"fold_sum{number}")
        return coarse, base

    def _coarse(self, feature: str) -> str:
        """Coarse points [coarse, 3] about the centre."""
        graph, weights = self.graph, self.weights
        source = feature
        for name in ("coarse1", "coarse2"):
            source = graph.relu(self._layer(name, source))
        weight, bias = weights["coarse3.weight"] * self.scale, weights["coarse3.bias"] * self.scale
        return graph.view(graph.linear(source, weight, bias, "coarse3"), [self.count, 3], "coarse_centered")

    def _folding(self, base: str) -> str:
        """Fine points [fine, 3]; returns the last hidden layer."""
        graph, weights = self.graph, self.weights
        graph.view(base, [self.count, 1, self.width], "fold_base")
        patch = self.network.patch.numpy() @ weights["fold1.weight"][:, :2].T
        graph.add("Add", ["fold_base", graph.constant("fold_patch", patch[None])], "fold1_cells")
        graph.view(graph.relu("fold1_cells"), [self.count * self.cells, self.width], "fold1")
        last = graph.relu(self._layer("fold2", "fold1"))
        graph.linear(last, weights["fold3.weight"] * self.scale, weights["fold3.bias"] * self.scale, "fold3")
        graph.view("fold3", [self.count, self.cells, 3], "offset")
        graph.view("coarse", [self.count, 1, 3], "coarse_cells")
        graph.add("Add", ["offset", "coarse_cells"], "fine_cells")
        graph.view("fine_cells", [self.count * self.cells, 3], "fine")
        return last

    def _probe(self, hidden: str, feature: str) -> str:
        """``NarrowNetwork._probe``: addition to the global feature [1, channels]."""
        graph, weights = self.graph, self.weights
        anchors = self.network.anchors.numpy()  # type: ignore[operator]
        graph.add("Sub", ["low", "center"], "low_centered")
        graph.add("Sub", ["high", "low"], "extent")
        graph.add("Mul", ["extent", graph.constant("anchors", anchors)], "anchors_scaled")
        places = graph.add("Add", ["low_centered", "anchors_scaled"], "anchor_places")
        rows = graph.nearest_rows(places, len(anchors), "anchor_rows")
        found = graph.add("Gather", ["centered", rows], "anchor_points", axis=0)
        graph.add("Sub", [found, places], "anchor_away")
        where = graph.add("Concat", [found, "anchor_away"], "anchor_where", axis=1)
        place = graph.linear(where, weights["token_place.weight"] / self.scale, None, "token_place")
        own = self._layer("token_hidden", graph.add("Gather", [hidden, rows], "anchor_hidden", axis=0))
        shared = self._layer("token_global", feature)
        tokens = graph.add("Add", [own, graph.add("Add", [place, shared], "token_shared")], "tokens")
        for number in range(len(self.network.token_blocks)):  # type: ignore[arg-type]
            tokens = self._block(f"token_blocks.{number}", tokens)
        graph.add("ReduceMax", [tokens, graph.integers(0)], "tokens_high", keepdims=1)
        return self._layer("token_out", "tokens_high")

    def _look(self, coarse: str, own: str) -> str:
        """``NarrowNetwork._look``: context of every coarse point [coarse, fold]."""
        from train.networks.narrow import LANDMARKS

        graph = self.graph
        weight, bias = self.weights["coarse_in.weight"] / self.scale, self.weights["coarse_in.bias"]
        tokens = graph.add("Add", [graph.linear(coarse, weight, bias, "coarse_in"), own], "coarse_tokens")
        step = self.count // LANDMARKS
        marks = [graph.integers(0), graph.integers(self.count), graph.integers(0), graph.integers(step)]
        return self._block("coarse_block", tokens, graph.add("Slice", [tokens, *marks], "landmarks"))

    def _block(self, name: str, tokens: str, memory: str = "") -> str:
        """A transformer block (``networks.attention.Block``) over [n, channels]."""
        block: Any = self.network.get_submodule(name)
        graph, heads = self.graph, int(block.attention.heads)
        normal = self._norm(f"{name}.before", tokens, f"{name}.normal")
        seen = self._norm(f"{name}.before", memory, f"{name}.seen") if memory else normal
        mixed = self._attend(f"{name}.attention", normal, seen, heads)
        attended = graph.add("Add", [tokens, mixed], f"{name}.attended")
        middle = self._norm(f"{name}.middle", attended, f"{name}.middle_normal")
        curved = graph.add("Gelu", [self._layer(f"{name}.mlp.0", middle)], f"{name}.curved")
        return graph.add("Add", [attended, self._layer(f"{name}.mlp.2", curved)], f"{name}.out")

    def _cue(self, coarse: str, hidden: str, rows: str, feature: str) -> list[str]:
        """``NarrowNetwork._cue``: two terms of the folding's first layer."""
        graph = self.graph
        self._plane(feature)
        other = graph.nearest_rows(self._mirrored(coarse, "image"), self.count, "mirror_rows")
        here = graph.add("Gather", ["centered", rows], "nearest_points", axis=0)
        there = self._mirrored(graph.add("Gather", ["centered", other], "mirror_points", axis=0), "back")
        evidence = [graph.add("Sub", [one, coarse], f"evidence{n}") for n, one in enumerate((here, there))]
        both = graph.add("Concat", evidence, "evidence", axis=1)
        of_mirror = graph.add("Gather", [hidden, other], "mirror_hidden", axis=0)
        return [
            self._layer("of_mirror", of_mirror),
            graph.linear(both, self.weights["of_evidence.weight"] / self.scale, None, "of_evidence"),
        ]


def example_input(network: CompletionModel, points: int = 64) -> Float32:
    """A cloud of the network's columns, for checks: float32 [points, columns]."""
    rng = np.random.default_rng(points)
    cloud = rng.normal(size=(points, network.columns)) * 0.2
    cloud[:, :3] += (0.0, 0.0, 0.2)
    if network.frame == "sight":
        cloud[:, :3] = cloud[:, :3] * network.scale + (8, -3, 0)
    return cloud.astype(np.float32)
