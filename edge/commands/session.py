# SPDX-License-Identifier: Apache-2.0
"""What ``replay``, ``run`` and ``demo`` share: model, publisher, pictures, pipeline; played, then reported."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from edge.commands import arguments
from edge.commands.interrupts import Interrupts
from edge.commands.report import Narrator, Tally, as_dict, lines
from edge.commands.run_recording import RunRecording
from edge.completion.manifest import find_model
from edge.completion.model import CompletionModel
from edge.errors import ExitCode
from edge.frames import RADARS, Float32, Pose, RadarFrame
from edge.pipeline import Pipeline, Sink
from edge.player import play, progress
from edge.plot.collector import PictureCollector
from edge.publish import PublishingSink
from edge.rig import Rig
from edge.service.live import LivePipeline
from edge.service.observer import Observer
from edge.service.serve import paced, serve
from edge.service.supervision import Supervision
from edge.sources.base import Loss
from edge.stream.publisher import Publisher
from edge.stream.wire import Source
from edge.version import version
from edge.warm import warm_up

JOIN_S = 1.2
"""Subscribers that wait for the address look for it every second at most."""


def add_arguments(parser: argparse.ArgumentParser, speed: str | None) -> None:
    """Options that the verbs share; ``speed`` None: frames come when they come."""
    help_text = "1 = as recorded, 2 = twice as fast, max = as fast as it goes (default: %(default)s)"
    if speed is None:
        parser.set_defaults(speed=0.0)
    else:
        parser.add_argument("--speed", type=arguments.speed, default=speed, help=help_text)
    parser.add_argument("--plot", type=Path, metavar="DIR", help="write pictures there (extra 'plot')")
    parser.add_argument("--endpoint", action="append", metavar="ADDRESS", help="publish there instead of the rig's")
    parser.add_argument("--no-publish", action="store_true", help="publish nothing")


def load_model(rig: Rig) -> tuple[CompletionModel | None, list[str]]:
    """The rig's model and what to say about it; a rig of one radar has no 3-D points and needs none."""
    if len(rig.radars) < len(RADARS):
        return None, ["one radar alone sees no height: heatmaps and detections only, no 3-D points and no shapes"]
    settings = rig.settings.completion
    model = CompletionModel.load(find_model(settings.model), settings)
    if not model.valid_for(rig.name):
        known = ", ".join(model.manifest.rigs)
        return None, [f"model {model.manifest.name} is not made for rig {rig.name} (only {known}): points, no shapes"]
    return model, []


class Session:
    """One run of a source through the pipeline.

    Args:
        rig: whose frames they are.
        args: parsed options of ``add_arguments``.
        source_kind: what the stream says its data are.
        title: line under every picture's title.
        notes: what a reader of the results should know.
        truth_odom_m: float32 [n, 3] of the true object, simulated scenes only.
        live: on the live pipeline's threads instead of all in one.
        patient: the live pipeline waits instead of dropping: for a source that is faster than its frames were.
    Attributes:
        observer: of the live pipeline; None: it is not live.
    """

    def __init__(
        self,
        rig: Rig,
        args: argparse.Namespace,
        source_kind: Source,
        title: str,
        notes: Sequence[str] = (),
        truth_odom_m: Float32 | None = None,
        *,
        live: bool = False,
        patient: bool = False,
    ) -> None:
        self.rig, self.tally, self.notes = rig, Tally(), list(notes)
        self._args, self._stack, self._interrupts = args, ExitStack(), Interrupts()
        self._undrawn = self._running = False
        model, more = load_model(rig)
        self.notes += more
        sinks: list[Sink] = [self.tally] if args.json else [self.tally, Narrator()]
        self._pictures: PictureCollector | None = None
        if args.plot is not None:
            self._pictures = PictureCollector(args.plot, title, truth_odom_m, rig.settings.association.fov_deg)
            sinks.append(self._pictures)
        self._publishing = None if args.no_publish else self._publisher(source_kind)
        if self._publishing is not None:
            sinks.append(self._publishing)
        self._recording = RunRecording.of(args, rig)
        if self._recording is not None and self._publishing is not None:
            self._publishing.published = self._recording.published
        self.observer: Observer | None = None
        self.pipeline: Pipeline | LivePipeline
        if live:
            self.pipeline = LivePipeline(rig, model, sinks, no_shapes="; ".join(more), patient=patient)
            self.observer = self._observe(self.pipeline)
        else:
            self.pipeline = Pipeline(rig, model, sinks)
            if self._publishing is not None:
                self._publishing.watch(self.pipeline)

    def _observe(self, pipeline: LivePipeline) -> Observer:
        """Look at the pipeline, and show it to subscribers, to the service manager and to whoever reads metrics."""
        publishing, versions = self._publishing, {"rfconstruct": version()}
        metrics, port = getattr(self._args, "metrics", None), getattr(self._args, "metrics_port", None)
        supervision = self._stack.enter_context(Supervision.of_environment(metrics, port))
        closed = publishing.closed if publishing is not None else str
        figures = self._recording.figures if self._recording is not None else None
        observer = Observer(
            pipeline, versions, supervision.progress, counts=self._counts, stream_closed=closed, recording=figures
        )
        if publishing is not None:
            publishing.watch(pipeline, observer.status)
            pipeline.beats.append(publishing.report)
        failures = publishing.auth_failures if publishing is not None else int
        pipeline.beats.append(lambda: supervision.show(lambda: observer.snapshot(failures())))
        return observer

    def _counts(self) -> dict[str, int]:
        """What could not be sent or recorded, by reason code."""
        counts = self._publishing.counts() if self._publishing is not None else {}
        dropped = self._recording.dropped() if self._recording is not None else 0
        return counts | ({"RECORDING_DROPPED": dropped} if dropped else {})

    def _publisher(self, kind: Source) -> PublishingSink:
        settings = self.rig.settings.stream
        if self._args.endpoint:
            settings = replace(settings, endpoints=tuple(self._args.endpoint))
        publisher = Publisher(settings, self.rig.config_hash, self.rig.calibration_hash, kind)
        self._stack.callback(publisher.close)
        self.say(f"publishing on {', '.join(publisher.endpoints)}")
        return PublishingSink(publisher, version())

    def say(self, text: str) -> None:
        """Print a line, unless stdout is for a machine."""
        if not self._args.json:
            print(text, flush=True)

    def stopped(self) -> bool:
        """Whether Ctrl-C or SIGTERM came; gives a sign of life when one is due."""
        if self._publishing is not None and self._running and self.observer is None:
            self._publishing.report()
        return self._interrupts.asked()

    def run(
        self,
        source: Iterable[RadarFrame | Pose | Loss],
        total: int | None,
        prepare: Callable[[], None] | None = None,
    ) -> None:
        """Play the source to its end, or until Ctrl-C or SIGTERM; either way the publisher says STOP.

        The addresses are bound before the kernels are ready: until then heartbeats say INIT.

        Args:
            source: frames, poses and losses.
            total: of its frames, when it knows.
            prepare: called when the kernels are ready: configures boards, for example.
        """
        publishing, asked = self._publishing, self._interrupts.asked
        idle = publishing.report if publishing is not None else None
        with self._stack, self._interrupts:
            if self._recording is not None:
                self._recording.open()
                self._stack.callback(self._recording.close)
                self.say(f"recording to {self._recording.path}")
                source = self._recording.tee(source)
            try:
                self._warm_up(prepare)
                self._running = True
                if publishing is not None and not asked():
                    publishing.invite(JOIN_S)
                if isinstance(self.pipeline, Pipeline):
                    play(source, self.pipeline, self._args.speed, total, not self._args.json, idle, asked)
                elif self.observer is not None:
                    self._serve(source, total, self.pipeline, self.observer)
            finally:
                self._running = False
                if publishing is not None:
                    publishing.report("STOP")
        if self._interrupts.received is not None:
            self.notes.append(f"ended by {self._interrupts.received.name}: the rest was not played")

    def _serve(
        self, source: Iterable[RadarFrame | Pose | Loss], total: int | None, pipeline: LivePipeline, observer: Observer
    ) -> None:
        """Play the source through the live pipeline."""
        asked = self._interrupts.asked
        with progress(total, not self._args.json) as bar:

            def taken(item: RadarFrame | Pose | Loss) -> None:
                if not isinstance(item, Pose):
                    bar.update(item.count if isinstance(item, Loss) else 1)

            serve(paced(source, self._args.speed, asked), pipeline, observer, asked, taken)

    def _warm_up(self, prepare: Callable[[], None] | None) -> None:
        start_s = time.monotonic()
        with self._publishing.starting() if self._publishing is not None else nullcontext():
            warm_up(self.rig, self.pipeline)
            self.say(f"kernels ready after {time.monotonic() - start_s:.1f} s")
            if prepare is not None and not self._interrupts.asked():
                prepare()

    def report(self, extra: dict[str, Any] | None = None) -> None:
        """Print the account on stdout, then draw: a picture that fails costs no figures."""
        if self._args.json:
            pictures = self._draw()
            content = {**as_dict(self.pipeline, self.tally, pictures, self.notes), **(extra or {})}
            if self._recording is not None:
                content["recording"] = self._recording.as_dict()
            print(json.dumps(content, indent=2))
            return
        print("\n".join(lines(self.pipeline, self.tally, self.notes)))
        if self._recording is not None:
            print("\n".join(["", *self._recording.lines()]))
        for key, value in (extra or {}).items():
            name, _, unit = key.rpartition("_")
            print(f"{name.replace('_', ' ')}: {value} {unit}" if unit in ("s", "cm") else f"{key}: {value}", flush=True)
        told = len(self.notes)
        for path in self._draw():
            print(f"picture: {path}")
        for note in self.notes[told:]:
            print(f"note: {note}")

    def exit_code(self, code: ExitCode) -> int:
        """That of the signal after an interrupted run; 3 instead of 0 when pictures or recording are incomplete."""
        if self._interrupts.asked():
            return self._interrupts.exit_code
        incomplete = self._undrawn or (self._recording is not None and self._recording.incomplete)
        return ExitCode.DEGRADED if incomplete and code == ExitCode.OK else code

    def _draw(self) -> list[Path]:
        """Pictures that were written; whatever the drawing library refuses becomes a note."""
        if self._pictures is None:
            return []
        if self._interrupts.asked():
            self.notes.append("no pictures of an interrupted run")
            return []
        paths: list[Path] = []
        try:
            paths.extend(self._pictures.write())
        except Exception as error:  # matplotlib, its fonts and the disk have no common root
            self._undrawn = True
            self.notes.append(f"pictures could not be drawn ({type(error).__name__}: {error})")
        return paths
