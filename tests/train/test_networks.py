# SPDX-License-Identifier: Apache-2.0
"""The networks that are compared: published sizes, invariances, and that switches begin at no effect and learn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from edge.errors import ConfigError
from train.losses import LossSettings, Matcher, completion_loss
from train.network import FINE_POINTS, SCALE_M, WIDTHS, CompletionModel, CompletionNetwork, middle
from train.networks.narrow import NarrowNetwork, NarrowOptions, mirrored
from train.networks.neighbours import farthest, fixed, neighbours, take
from train.networks.registry import NETWORKS, build, parse_options

EVERYTHING = {
    "mirror": "cue", "attention": "both", "uncertainty": True, "coarse": 512, "power": True, "ground": True,
}  # fmt: skip
CASES = [("paper", {}), ("pcn", {}), ("narrow", {}), ("narrow", EVERYTHING), ("adapointr", {})]
CENTERED = [*CASES, ("narrow", {"trim": 5})]
QUERIES = [("queries", {}), ("queries", {"mirror": False, "denoise": False})]


def network_of(name: str, options: dict[str, object]) -> CompletionModel:
    torch.manual_seed(2)
    return build(name, "tiny", options=options)  # type: ignore[arg-type]


def cloud(points: int, columns: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.randn(points, 3, generator=generator) * torch.tensor([1.5, 0.7, 0.4]) + torch.tensor([9.0, 2.0, 0.8])
    return torch.cat([xyz, torch.randn(points, 1, generator=generator) * 6], 1)[:, :columns]


@pytest.mark.parametrize(("name", "parameters"), [("paper", 7_385_347), ("pcn", 6_861_059)])
def test_parameters_equal_the_ones_derived_from_the_descriptions(name: str, parameters: int) -> None:
    counted = build(name).named_parameters()
    assert sum(p.numel() for key, p in counted if not key.startswith("class")) == parameters


def test_transformer_has_about_the_published_size() -> None:
    assert build("adapointr").parameter_count == pytest.approx(32.5e6, rel=0.05)
    assert build("adapointr", "small").parameter_count < 2e6


@pytest.mark.parametrize(("name", "macs"), [("paper", 6_012_420_096), ("pcn", 5_737_693_184)])
def test_multiplications_equal_the_ones_derived_from_the_layers(name: str, macs: int) -> None:
    """2048 points in, 16384 out, the short form. The training code alone computes the winning rows of the encoder again
    (1024 x 512), the product of the folding's local and the encoder's last weights (512 x 1024 x 512) and of the former
    with a bias (512 x 1024, not counted), and has a class head; PCN's distances to the input are not needed."""
    with FakeTensorMode(), torch.no_grad(), FlopCounterMode(display=False) as counter:  # shapes only, no arithmetic
        build(name)(torch.empty(2048, 3), [2048])
    again = 1024 * 512
    own = 512 * 1024 * 512 + 1024 * 256 + 256 * 4 if name == "paper" else 0
    assert counter.get_total_flops() == 2 * (macs + again + own)


@pytest.mark.parametrize(("name", "options"), [*CASES, *QUERIES])
def test_sizes_gradients_and_order(name: str, options: dict[str, object]) -> None:
    network = network_of(name, options)
    for layer in network.modules() if options else ():  # what starts at zero hides what is behind it
        if isinstance(layer, torch.nn.Linear) and not layer.weight.any():
            torch.nn.init.normal_(layer.weight, std=0.05)
    counts = [90, 300, 64]
    points = torch.cat([cloud(n, network.columns, n) for n in counts])
    truth = torch.cat([cloud(600, 3, 7 + n)[None] for n in counts])
    output = network(points, counts, torch.arange(network.cells // 4))
    assert output.coarse.shape == (3, network.coarse_points, 3)
    assert output.fine.shape == (3, FINE_POINTS // 4, 3)
    assert output.logits.shape == (3, 4 if name in ("paper", "narrow", "queries") else 0)
    settings = LossSettings(emd_points=128)
    generator = torch.Generator().manual_seed(0)
    labels = torch.tensor([0, 1, 3])
    terms = completion_loss(output, truth, labels, 0.5, settings, Matcher(1), generator, network)
    terms.total.backward()
    assert torch.isfinite(terms.total)
    for key, parameter in network.named_parameters():
        if name == "pcn" and key.startswith("class"):
            continue
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key
        assert parameter.grad.abs().sum() > 0 or key.endswith("key_value.weight"), key


@pytest.mark.parametrize(("name", "options"), CENTERED)
def test_order_and_repetition_of_points_do_not_matter(name: str, options: dict[str, object]) -> None:
    network = network_of(name, options).double().eval()
    points = cloud(128, network.columns).double()
    order = torch.randperm(128, generator=torch.Generator().manual_seed(1))
    changes = [points[order]]
    if name != "adapointr":  # its grouping takes a fixed number of points, here 128
        changes.append(torch.cat([points[order], points if "trim" in options else points[:77]]))
    with torch.no_grad():
        reference = network(points, [128])
        for changed in changes:
            output = network(changed, [len(changed)])
            torch.testing.assert_close(output.fine, reference.fine, atol=1e-7, rtol=0)
            torch.testing.assert_close(output.coarse, reference.coarse, atol=1e-7, rtol=0)


def test_with_all_switches_off_narrow_is_the_papers_and_attention_starts_at_no_move() -> None:
    plain, points = CompletionNetwork(WIDTHS["tiny"], 4), cloud(150, 3)
    with torch.no_grad():
        reference = plain(points, [150])
        switched = (NarrowOptions(attention="tokens"), NarrowOptions(mirror="plane", uncertainty=True))
        for options in (NarrowOptions(), *switched):
            narrow = NarrowNetwork(WIDTHS["tiny"], 4, "sight", options)
            narrow.load_state_dict(plain.state_dict(), strict=False)
            torch.testing.assert_close(narrow(points, [150]).fine, reference.fine, atol=1e-6, rtol=0)
        narrow = NarrowNetwork(WIDTHS["tiny"], 4, "sight", NarrowOptions(attention="coarse"))
        narrow.load_state_dict(plain.state_dict(), strict=False)
        torch.testing.assert_close(narrow(points, [150]).coarse, reference.coarse, atol=1e-6, rtol=0)


def test_options_that_are_added_to_trained_weights_begin_at_no_effect() -> None:
    plain, points = CompletionNetwork(WIDTHS["tiny"], 4), cloud(150, 3)
    options = NarrowOptions(mirror="cue", attention="tokens", uncertainty=True)
    richer = NarrowNetwork(WIDTHS["tiny"], 4, "sight", options)
    missing = richer.load_state_dict(plain.state_dict(), strict=False).missing_keys
    assert richer.begin_without(missing)
    with torch.no_grad():
        torch.testing.assert_close(richer(points, [150]).fine, plain(points, [150]).fine, atol=1e-6, rtol=0)
    assert richer.begin_without([])
    assert not richer.begin_without([*missing, "fc.0.weight"])
    assert not plain.begin_without(missing)


def test_trimmed_middle_is_that_of_what_is_left() -> None:
    line = torch.arange(41.0)[torch.randperm(41, generator=torch.Generator().manual_seed(3))]
    places = torch.stack([line, 2 * line, torch.zeros(41)], 1)
    places[line == 40] = torch.tensor([1000.0, -500.0, 0.0])
    torch.testing.assert_close(middle(places), torch.tensor([500.0, -211.0, 0.0]))
    torch.testing.assert_close(middle(places, 5), torch.tensor([20.0, 38.0, 0.0]), msg="two of 41 at each end")
    torch.testing.assert_close(middle(places[:19], 5), middle(places[:19]), msg="no point to leave out of 19")


def test_with_trim_a_few_points_far_away_do_not_move_the_centre() -> None:
    """5 % of a dense cloud, all on one side: the centre moves by no more than those places on the other side."""
    inside = torch.rand(950, 3, generator=torch.Generator().manual_seed(4))
    strays = torch.tensor([3.0, 5.0, 0.0]).expand(40, 3)
    for trim, least_m, most_m in ((0, 1.0, 3.0), (5, 0.0, 0.04)):
        network = NarrowNetwork(WIDTHS["tiny"], 4, "sight", NarrowOptions(trim=trim)).eval()
        with torch.no_grad():
            clean, soiled = (network(p, [len(p)]).center for p in (inside, torch.cat([inside, strays])))
        assert clean is not None
        assert soiled is not None
        moved = (soiled - clean)[0].abs()
        assert (moved[:2] >= least_m).all(), (trim, moved)
        assert (moved[:2] <= most_m).all(), (trim, moved)
        assert moved[2] == 0, "height is from the ground"


def test_mirror_image() -> None:
    points = torch.tensor([[[1.0, 2.0, 3.0], [0.0, 0.5, 1.0]]])
    about_y = torch.tensor([[0.0, 1.0, 0.5]])
    torch.testing.assert_close(mirrored(points, about_y), torch.tensor([[[1.0, -1.0, 3.0], [0.0, 0.5, 1.0]]]))
    slanted = torch.tensor([[0.6, 0.8, -0.3]])
    torch.testing.assert_close(mirrored(mirrored(points, slanted), slanted), points)


def test_box_frame_is_neither_centred_nor_scaled() -> None:
    torch.manual_seed(0)
    sight, box = (CompletionNetwork(WIDTHS["tiny"], 4, frame).double() for frame in ("sight", "box"))
    box.load_state_dict(sight.state_dict())
    points = torch.rand(120, 3, dtype=torch.float64)
    ends = torch.tensor([[-1.0, -1.0, 0.2], [1.0, 1.0, 0.3]], dtype=torch.float64)
    points = torch.cat([points, ends])  # their box is already about 0
    with torch.no_grad():
        torch.testing.assert_close(box(points, [122]).fine * SCALE_M, sight(points * SCALE_M, [122]).fine)
        moved = box(points + 0.1, [122]).fine - box(points, [122]).fine
    assert (moved - 0.1).abs().max() > 1e-3
    with pytest.raises(ConfigError, match="ground"):
        build("narrow", "tiny", "box", {"ground": True})


@pytest.mark.parametrize("name", ["adapointr", "queries"])
def test_noisy_queries_do_not_change_the_true_ones(name: str) -> None:
    network, points = network_of(name, {}), cloud(100, 3)
    with torch.no_grad():
        training, answer = network.train()(points, [100]), network.eval()(points, [100])
    torch.testing.assert_close(training.fine, answer.fine, atol=1e-4, rtol=0)
    assert training.denoised is not None
    assert answer.denoised is None


def test_rounded_inner_layers_move_points_by_little() -> None:
    """bfloat16 keeps 8 bits: 0.4 % of what a layer computes; coordinates themselves are never rounded (5 m: 2 cm)."""
    network, points = network_of("narrow", {}).eval(), cloud(200, 3)
    with torch.no_grad():
        exact = network(points, [200])
        with torch.autocast("cpu", torch.bfloat16):
            rounded = network(points, [200])
    assert rounded.coarse.dtype == torch.float32
    error_m = (rounded.coarse - exact.coarse).abs().mean()
    assert error_m < 0.005


def test_point_set_operations_equal_brute_force() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2, 60, 3, generator=generator)
    chosen = farthest(points, 10)
    for own, rows in zip(points.numpy(), chosen.numpy(), strict=True):
        assert len(set(rows)) == 10
        for k in range(1, 10):
            gaps = np.linalg.norm(own[:, None] - own[None, rows[:k]], axis=2).min(1)
            assert gaps[rows[k]] == pytest.approx(gaps.max())
    index = neighbours(points[:, :7], points, 4)
    expected = torch.cdist(points[:, :7], points).argsort(-1)[..., :4]
    assert torch.equal(index, expected)
    assert torch.equal(take(points, index)[1, 2, 3], points[1, index[1, 2, 3]])
    both, first = fixed(torch.arange(15.0)[:, None].expand(-1, 3), [3, 12], 6)
    assert both[..., 0].tolist() == [[0, 1, 2, 0, 1, 2], [3, 5, 7, 9, 11, 13]]
    assert first.sum(1).tolist() == [3, 6]


def test_options_are_typed_and_the_unknown_is_refused() -> None:
    parsed = parse_options("narrow", ["mirror=cue", "coarse=512", "power=true"])
    assert parsed == {"mirror": "cue", "coarse": 512, "power": True}
    for name, pairs in (("narrow", ["colour=red"]), ("pcn", ["mirror=cue"]), ("narrow", ["power=1"]), ("none", [])):
        with pytest.raises(ConfigError):
            parse_options(name, pairs)
    wrong = [("narrow", "huge"), ("nothing",), ("narrow", "tiny", "sight", {"mirror": "always"})]
    for arguments in (*wrong, *((name, "tiny", "box", {"trim": 5}) for name in ("narrow", "queries"))):
        with pytest.raises(ConfigError):
            build(*arguments)  # type: ignore[arg-type]
    assert set(NETWORKS) == {"narrow", "queries", "paper", "pcn", "adapointr"}
