# SPDX-License-Identifier: Apache-2.0
"""Endurance: a drive without end at its own pace through the live pipeline and the publisher, then the account."""

from __future__ import annotations

import os
import resource
import tempfile
import time
from array import array
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.bench.endless import EndlessDrive
from edge.completion.model import CompletionModel
from edge.frames import LossCause
from edge.publish import PublishingSink
from edge.rig import Rig
from edge.service.live import LivePipeline
from edge.service.machine import rss_bytes
from edge.service.observer import Observer
from edge.service.serve import paced, serve
from edge.service.shared_times import SharedTimes
from edge.stream.publisher import Publisher
from edge.version import version
from edge.warm import warm_up

DEADLINE_CAUSES = (LossCause.OVERFLOW, LossCause.SHED, LossCause.FAILED)
"""Losses of a machine that cannot follow, not of the data."""
SETTLED_SHARE = 0.2
"""Memory and processor time are counted after this share of the run."""
SAMPLE_S = 1.0
GROWTH_S = 600.0
"""Shorter runs say nothing about growth: memory pools still fill."""
KEPT_STAGES = ("to_points", "to_shape")
LIMITS = {
    "unaccounted frames": 0.0,
    "deadline drops, share": 1e-4,
    "last byte to points p99, ms": 15.0,
    "asked to shape p99, ms": 150.0,
    "process without network, share of a core": 0.7,
    "RSS at the end, MB": 400.0,
    "RSS growth, MB/h": 5.0,
    "warm start, s": 5.0,
}
"""Figure -> largest value of the requirement (10 minutes on two quiet cores)."""


class _RunTimes(SharedTimes):
    """Keeps every measurement of the stages whose percentiles are of the whole run."""

    def __init__(self) -> None:
        super().__init__()
        self.kept = {stage: array("f") for stage in KEPT_STAGES}

    def record(self, stage: str, duration_us: float) -> None:
        """Add one measurement in microseconds."""
        super().record(stage, duration_us)
        if stage in self.kept:
            self.kept[stage].append(duration_us)


@dataclass(slots=True)
class _Samples:
    """Memory and processor time of this process, once a second."""

    at_s: list[float] = field(default_factory=list)
    rss_mb: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    network_s: list[float] = field(default_factory=list)

    def take(self, network_s: float) -> None:
        """One sample when the last is a second old."""
        now_s = time.monotonic()
        if not self.at_s or now_s - self.at_s[-1] >= SAMPLE_S:
            self.at_s.append(now_s)
            self.rss_mb.append(rss_bytes() / 2**20)
            self.cpu_s.append(time.process_time())
            self.network_s.append(network_s)

    def figures(self) -> dict[str, float]:
        """Of the settled part: shares of a core, memory, its growth by a straight line."""
        first = min(round(SETTLED_SHARE * len(self.at_s)), max(len(self.at_s) - 2, 0))
        at_s, rss_mb = np.array(self.at_s[first:]), np.array(self.rss_mb[first:])
        span_s = max(float(at_s[-1] - at_s[0]), 1e-9)
        process = (self.cpu_s[-1] - self.cpu_s[first]) / span_s
        network = (self.network_s[-1] - self.network_s[first]) / span_s
        slope = float(np.polyfit(at_s - at_s[0], rss_mb, 1)[0]) if len(at_s) > 2 else 0.0
        return {
            "process, share of a core": process,
            "process without network, share of a core": process - network,
            "RSS settled, MB": float(rss_mb[0]),
            "RSS at the end, MB": float(rss_mb[-1]),
            "RSS growth, MB/h": slope * 3600.0,
        }


def soak(
    rig: Rig,
    path: Path,
    seconds: float,
    completion: CompletionModel | None,
    no_shapes: str = "",
    stopped: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Play a recorded drive again and again.

    Args:
        rig: of the recording.
        path: MCAP recording, see ``EndlessDrive``.
        seconds: of the run.
        completion: None: no shapes.
        no_shapes: why.
        stopped: ends the run before its time.
    Returns:
        "figures": name -> number; "accounts"; "stages"; "threads": name -> share of a core; "reasons"; "rss_mb" once a
        second; "load" of the machine.
    """
    start_s = time.monotonic()
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rfconstruct-soak-"))
        settings = replace(rig.settings.stream, endpoints=(f"ipc://{folder}/stream",))
        publisher = stack.enter_context(Publisher(settings, rig.config_hash, rig.calibration_hash, "replay"))
        sink, times, drive = PublishingSink(publisher, version()), _RunTimes(), EndlessDrive(path, seconds)
        road = LivePipeline(rig, completion, [sink], no_shapes=no_shapes, times=times)
        observer = Observer(road, {"rfconstruct": version()}, counts=sink.counts)
        sink.watch(road, observer.status)
        road.beats.append(sink.report)
        warm_up(rig, road)
        warm_s, samples, steps = time.monotonic() - start_s, _Samples(), set[int]()

        def watch() -> bool:
            samples.take(road.stages[-2].cpu_s)
            steps.add(int(road.shedder.step))
            return stopped()

        began_s = time.monotonic()
        serve(paced(drive, 1.0, stopped), road, observer, watch)
        ran_s = time.monotonic() - began_s
    figures = {
        **_counts(road, ran_s),
        **_latencies(times),
        **samples.figures(),
        "RSS peak, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "warm start, s": warm_s,
        "load shedding, highest step": float(max(steps, default=0)),
        "passes": float(drive.passes),
    }
    return {
        "figures": figures,
        "accounts": {radar: ledger.snapshot().as_dict() for radar, ledger in road.ledgers.items()},
        "stages": {stage: [t.count, t.p50_us, t.p99_us, t.max_us] for stage, t in times.summary().items()},
        "threads": {stage.name: stage.cpu_s / ran_s for stage in road.stages},
        "reasons": sorted({reason.code for reason in observer.verdict.reasons}),
        "rss_mb": [round(rss_mb, 2) for rss_mb in samples.rss_mb],
        "load": list(os.getloadavg()),
    }


def _counts(road: LivePipeline, ran_s: float) -> dict[str, float]:
    """Frames and shapes of a run that has ended."""
    accounts = {radar: ledger.snapshot() for radar, ledger in road.ledgers.items()}
    frames_in = sum(account.frames_in for account in accounts.values())
    dropped = sum(account.lost.get(cause, 0) for account in accounts.values() for cause in DEADLINE_CAUSES)
    return {
        "seconds": ran_s,
        "pairs a second": min(account.frames_ok for account in accounts.values()) / ran_s,
        "unaccounted frames": float(sum(abs(account.pending) for account in accounts.values())),
        "deadline drops, share": dropped / max(frames_in, 1),
        "shapes": float(sum(road.shapes.values())),
        "shapes skipped": float(road.shapes_skipped),
        "results not delivered": float(road.outbox.dropped + road.sink_failures),
    }


def missed(result: dict[str, Any]) -> list[str]:
    """Figures beyond their limit, in words."""
    figures = result["figures"]
    return [
        f"{name}: {figures[name]:.4g}, at most {limit:g}"
        for name, limit in LIMITS.items()
        if figures.get(name, 0.0) > limit and not (name.startswith("RSS growth") and figures["seconds"] < GROWTH_S)
    ]


def lines(result: dict[str, Any]) -> list[str]:
    """The table for people."""
    text = [f"{'radar':<12}{'frames in':>10}{'ok':>9}{'lost':>8}  causes"]
    for radar, account in result["accounts"].items():
        causes = ", ".join(f"{cause} {count}" for cause, count in account["lost"].items())
        counts = f"{account['frames_in']:>10}{account['frames_ok']:>9}{account['frames_lost']:>8}"
        text.append(f"{radar:<12}{counts}  {causes}")
    text += ["", f"{'figure':<44}{'value':>12}{'at most':>10}"]
    for name, value in result["figures"].items():
        limit = f"{LIMITS[name]:g}" if name in LIMITS else ""
        text.append(f"{name:<44}{value:>12.4g}{limit:>10}")
    text += ["", f"{'stage':<12}{'calls':>10}{'p50 ms':>10}{'p99 ms':>10}{'max ms':>10}  (of the last minute)"]
    for stage, (count, *times_us) in result["stages"].items():
        text.append(f"{stage:<12}{count:>10}" + "".join(f"{t / 1e3:>10.3f}" for t in times_us))
    shares = ", ".join(f"{name} {100 * share:.1f} %" for name, share in result["threads"].items())
    text += ["", f"threads, share of a core: {shares}"]
    text.append(f"load of the machine over 1, 5, 15 minutes: {', '.join(f'{load:.1f}' for load in result['load'])}")
    text += [f"beyond its limit: {words}" for words in missed(result)]
    return text


def _latencies(times: _RunTimes) -> dict[str, float]:
    found: dict[str, float] = {}
    for stage, name in (("to_points", "last byte to points"), ("to_shape", "asked to shape")):
        if times.kept[stage]:
            p50, p99, p999 = np.percentile(times.kept[stage], (50, 99, 99.9)) / 1e3
            found |= {f"{name} p50, ms": float(p50), f"{name} p99, ms": float(p99), f"{name} p99.9, ms": float(p999)}
            found[f"{name} max, ms"] = max(times.kept[stage]) / 1e3
    return found
