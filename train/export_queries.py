# SPDX-License-Identifier: Apache-2.0
"""The edge graph of ``networks.queries``: method by method what the network computes, in network units inside."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import helper

from train.export_parts import Parts
from train.networks.queries import QueryNetwork
from train.networks.sampling import order

_FAR = 1e6
_KIND = 3
"""Columns of a query's position, before those of its kind."""


class QueryBuilder(Parts):
    """The graph of one object; see ``export.build`` for inputs and outputs."""

    network: QueryNetwork

    def __init__(self, network: QueryNetwork) -> None:
        super().__init__(network)
        self.unit, self.scale = self.scale, np.float32(1)
        self.width, self.count, self.cells = network.width, network.coarse_points, network.cells

    def model(self, classifier: bool = True) -> onnx.ModelProto:
        """The whole graph."""
        graph, fine = self.graph, self.count * self.cells
        self._center()
        self._cloud()
        self._spread()
        memory = self._encode()
        wide = self._perceptron("widen", memory)
        graph.add("ReduceMax", [wide, graph.integers(0)], "feature", keepdims=1)
        self._queries("feature")
        tokens = self._decode(memory)
        last = self._rebuild(tokens)
        self._metres("asked_places", "coarse")
        patches = graph.view(self._layer("rebuild2", last), [self.count, self.cells, 3], "patches")
        centers = graph.view("asked_places", [self.count, 1, 3], "patch_centers")
        graph.view(graph.add("Add", [patches, centers], "cells"), [fine, 3], "fine_units")
        self._metres("fine_units", "fine")
        outputs: dict[str, tuple[int, ...]] = {"fine": (fine, 3), "coarse": (self.count, 3)}
        if classifier:
            graph.add("Softmax", [self._perceptron("classifier", "feature")], "softmax", axis=1)
            graph.view("softmax", [self.network.classes], "class_probability")
            outputs["class_probability"] = (self.network.classes,)
        bias = self.weights["sigma.bias"] + np.log(self.unit)
        graph.add("Exp", [graph.linear(last, self.weights["sigma.weight"], bias, "sigma_log")], "sigma_cells")
        graph.view("sigma_cells", [fine], "sigma")
        return graph.model({**outputs, "sigma": (fine,)})

    def _metres(self, source: str, output: str) -> str:
        """Network units about the centre, back in the unit of the input."""
        graph = self.graph
        scaled = graph.add("Mul", [source, graph.constant("unit", np.array(self.unit, np.float32))], f"{output}_scaled")
        return graph.add("Add", [scaled, "center"], output)

    def _perceptron(self, name: str, source: str) -> str:
        """``networks.attention.perceptron``."""
        graph = self.graph
        own = [key.removeprefix(f"{name}.") for key in self.weights if key.startswith(f"{name}.")]
        for number in sorted({int(key.split(".")[0]) for key in own}):
            if number:
                source = graph.add("Gelu", [source], f"{name}.{number - 1}")
            source = self._layer(f"{name}.{number}", source)
        return source

    def _topk(self, source: str, count: int, output: str, largest: int, values: bool = False) -> str:
        """Places, or with ``values`` the numbers themselves, of the largest or smallest of every row, in order."""
        k, outputs = self.graph.integers(count), [f"{output}_values", output]
        node = helper.make_node("TopK", [source, k], outputs, name=output, axis=-1, largest=largest)
        self.graph.nodes.append(node)
        return outputs[0] if values else output

    def _cloud(self) -> None:
        """``sampling.shuffled`` in network units: "drawn" [points, 3], "drawn_first" bool [points]."""
        graph, size = self.graph, self.width.points
        step = graph.constant("drawn_order", np.array(order(size), np.int64))
        graph.add("Shape", ["points"], "points_count", start=0, end=1)
        repeated = graph.add("Mod", [step, "points_count"], "rows_repeated")
        product = graph.add("Mul", [step, "points_count"], "rows_product")
        thinned = graph.add("Div", [product, graph.integers(size)], "rows_thinned")
        few = graph.add("LessOrEqual", ["points_count", graph.integers(size)], "points_few")
        rows = graph.add("Where", [few, repeated, thinned], "drawn_rows")
        chosen = graph.add("Gather", ["centered", rows], "drawn_metres", axis=0)
        graph.add("Mul", [chosen, graph.constant("per_unit", np.array(1 / self.unit, np.float32))], "drawn")
        graph.add("Less", [step, "points_count"], "drawn_first")

    def _norms(self, points: str) -> str:
        """Squared lengths as a row: [1, n]."""
        graph = self.graph
        square = graph.add("Mul", [points, points], f"{points}_square")
        column = graph.add("ReduceSum", [square, graph.integers(1)], f"{points}_norms", keepdims=1)
        return graph.add("Transpose", [column], f"{points}_norm", perm=[1, 0])

    def _apart(self, queries: str, points: str, norms: str, output: str) -> str:
        """Squared distances less those of the queries from the origin: [q, 3], [n, 3], [1, n] -> [q, n]."""
        return self.graph.add("Gemm", [queries, points, norms], output, alpha=-2.0, transB=1)

    def _spread(self) -> None:
        """``sampling.spread``: "places" [proxies, 3], whether they repeat none, and "drawn_norm_first"."""
        graph, size = self.graph, self.width.points
        steps = np.arange(size, dtype=np.int64)
        column, row = graph.constant("steps_column", steps[:, None]), graph.constant("steps_row", steps[None])
        later = graph.add("LessOrEqual", [column, row], "later")
        none, far = (graph.constant(n, np.array(v, np.float32)) for n, v in (("zero", 0), ("far_value", _FAR)))
        graph.add("Where", [later, far, none], "later_far")  # constant: made when the model is loaded
        norms = self._norms("drawn")
        penalty = graph.add("Where", ["drawn_first", none, far], "penalty")
        graph.add("Add", [norms, penalty], "drawn_norm_first")
        turned = graph.add("Transpose", ["drawn_norm_first"], "drawn_norm_column", perm=[1, 0])
        ones = graph.constant("ones", np.ones((size, 1), np.float32))
        minus = graph.add("Mul", ["drawn", graph.constant("minus_two", np.array(-2, np.float32))], "drawn_minus")
        own = graph.add("Concat", [minus, ones], "drawn_own", axis=1)
        others = graph.add("Concat", ["drawn", turned], "drawn_others", axis=1)
        before = graph.add("Gemm", [own, others, "later_far"], "drawn_before", transB=1)
        nearest = graph.add("ReduceMin", [before, graph.integers(1)], "drawn_nearest", keepdims=0)
        square = graph.add("Add", [nearest, graph.view(norms, (size,), "drawn_norms_flat")], "drawn_radius")
        last = graph.constant("last", -(steps + 1).astype(np.float32))
        rank = graph.add("Where", ["drawn_first", square, last], "drawn_rank")
        count = self.width.proxies
        rows = self._topk(self._topk(rank, count, "proxies", 1), count, "proxies_rising", 0, values=True)
        graph.add("Gather", ["drawn", rows], "places", axis=0)
        graph.add("Gather", ["drawn_first", rows], "places_new", axis=0)

    def _near(self, queries: str, points: str, norms: str, count: int, output: str) -> str:
        """Rows of the nearest points: int64 [q, count]."""
        return self._topk(self._apart(queries, points, norms, f"{output}_apart"), count, output, 0)

    def _encode(self) -> str:
        """Encoded proxies [proxies, channels]."""
        graph, width = self.graph, self.width
        index = self._near("places", "drawn", "drawn_norm_first", width.group, "group_rows")
        hidden = graph.add("Gather", [self._layer("near_point", "drawn"), index], "group_points", axis=0)
        own = self._layer("near_center", "places")
        own = graph.view(own, (width.proxies, 1, width.local[0]), "group_centers")
        rows = graph.view(graph.relu(graph.add("Sub", [hidden, own], "group_in")), (-1, width.local[0]), "group_flat")
        each = graph.view(self._layer("group", rows), (width.proxies, width.group, -1), "group_each")
        most = graph.relu(graph.add("ReduceMax", [each, graph.integers(1)], "group_most", keepdims=0))
        proxies, where = self._perceptron("proxy", most), self._perceptron("place", "places")
        tokens = graph.add("Add", [proxies, where], "tokens")
        near = self._near("places", "places", self._norms("places"), width.near, "places_near")
        for number in range(width.encoder):
            tokens = self._block(f"encoder.{number}", tokens, near)
        return tokens

    def _block(self, name: str, tokens: str, near: str, memory: str = "", of_memory: str = "") -> str:
        """``attention.NearLayer``: [q, channels] -> [q, channels]."""
        graph = self.graph
        normal = self._norm(f"{name}.norms.0", tokens, f"{name}.normal")
        tokens = graph.add("Add", [tokens, self._mixed(f"{name}.own", normal, normal, near)], f"{name}.after_own")
        if memory:
            mine = self._norm(f"{name}.norms.2", tokens, f"{name}.asking")
            seen = self._norm(f"{name}.norms.3", memory, f"{name}.seen")
            mixed = self._mixed(f"{name}.cross", mine, seen, of_memory)
            tokens = graph.add("Add", [tokens, mixed], f"{name}.after_cross")
        middle = self._norm(f"{name}.norms.1", tokens, f"{name}.middle")
        return graph.add("Add", [tokens, self._perceptron(f"{name}.mlp", middle)], f"{name}.out")

    def _mixed(self, name: str, own: str, others: str, index: str) -> str:
        """the attention of ``NearLayer`` and what is beside it."""
        graph = self.graph
        value = self._attend(f"{name}.attention", own, others, self.width.heads)
        if f"{name}.join.weight" not in self.weights:
            return value
        found = graph.add("Gather", [self._layer(f"{name}.edge.other", others), index], f"{name}.found", axis=0)
        most = graph.add("ReduceMax", [found, graph.integers(1)], f"{name}.most", keepdims=0)
        both = graph.add("Add", [most, self._layer(f"{name}.edge.own", own)], f"{name}.edge")
        edge = graph.add("LeakyRelu", [both], f"{name}.edge_out", alpha=0.2)
        return self._layer(f"{name}.join", graph.add("Concat", [value, edge], f"{name}.both", axis=1))

    def _of_kinds(self, name: str, marked: str, feature: str) -> str:
        """Hidden layer of the score or of the query: position and kind in one part, the global feature in another."""
        shared = self._layer(f"{name}_feature", feature)
        hidden = self.graph.linear(marked, self.weights[f"{name}_place.weight"], shared, f"{name}_place")
        return self.graph.add("Gelu", [hidden], f"{name}_hidden")

    def _queries(self, feature: str) -> None:
        """Queries "asked" [queries, 6], of these "asked_places" [queries, 3], and "asked_score" [queries, 1]."""
        graph, proxies, made = self.graph, self.width.proxies, self.network.predicted
        predicted = graph.view(self._perceptron("coarse", feature), (made, _KIND), "predicted")
        parts, new = ["places"], ["places_new"]
        if self.network.options.mirror:
            self._plane(feature)
            parts, new = [*parts, self._mirrored("places", "image")], [*new, "places_new"]
        kinds = np.eye(3, dtype=np.float32)
        own, seen = np.repeat(kinds[:1], made, axis=0), np.repeat(kinds[1 : 1 + len(parts)], proxies, axis=0)
        graph.add("Concat", [predicted, graph.constant("kind_predicted", own)], "asked_predicted", axis=1)
        every = graph.add("Concat", parts, "candidate_places", axis=0)
        graph.add("Concat", [every, graph.constant("kinds", seen)], "candidates", axis=1)
        hidden = self._of_kinds("score", "candidates", feature)
        score = graph.add("Sigmoid", [self._perceptron("score", hidden)], "scores")
        last = graph.constant("candidate_last", -np.arange(1, len(seen) + 1, dtype=np.float32))
        known = graph.add("Concat", new, "candidate_new", axis=0)
        rank = graph.add("Where", [known, graph.view(score, (-1,), "scores_flat"), last], "candidate_rank")
        best = self._topk(rank, self.count - made, "best", 1)
        chosen = self._topk(best, self.count - made, "chosen", 0, values=True)
        found = graph.add("Gather", ["candidates", chosen], "asked_seen", axis=0)
        graph.add("Concat", ["asked_predicted", found], "asked", axis=0)
        given = graph.constant("score_predicted", np.ones((made, 1), np.float32))
        graph.add("Concat", [given, graph.add("Gather", [score, chosen], "score_seen", axis=0)], "asked_score", axis=0)
        graph.add("Slice", ["asked", *(graph.integers(n) for n in (0, _KIND, 1))], "asked_places")

    def _decode(self, memory: str) -> str:
        """Tokens of the queries [queries, channels]."""
        graph, near = self.graph, self.width.near
        tokens = self._perceptron("query", self._of_kinds("query", "asked", "feature"))
        tokens = graph.add("Mul", [tokens, "asked_score"], "query_tokens")
        own = self._near("asked_places", "asked_places", self._norms("asked_places"), near, "asked_near")
        of_memory = self._near("asked_places", "places", "places_norm", near, "asked_of_memory")
        for number in range(self.width.decoder):
            tokens = self._block(f"decoder.{number}", tokens, own, memory, of_memory)
        return tokens

    def _rebuild(self, tokens: str) -> str:
        """Last hidden layer of the patches [queries, rebuild]."""
        graph = self.graph
        both = graph.add("Concat", [tokens, "asked_places"], "reduce_in", axis=1)
        weight, bias = self.weights["reduce_feature.weight"], self.weights["reduce.bias"]
        shared = graph.linear("feature", weight, bias, "reduce_feature")
        reduced = graph.linear(both, self.weights["reduce.weight"], shared, "reduce")
        top = graph.add("ReduceMax", [reduced, graph.integers(0)], "reduced_most", keepdims=1)
        shared = graph.linear(top, self.weights["top.weight"], self.weights["rebuild1.bias"], "top")
        hidden = graph.linear(reduced, self.weights["rebuild1.weight"], shared, "rebuild1")
        return graph.add("Gelu", [hidden], "rebuilt")
