# SPDX-License-Identifier: Apache-2.0
"""Listening: shapes are saved under names that no other shape can take."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_run import rfconstruct

from edge.commands.listen_command import free_path
from edge.config import StreamSettings
from edge.errors import ExitCode
from edge.frames import ObjectCloud, Pose, Shape
from edge.stream.messages import ShapeMessage
from edge.stream.publisher import Publisher

CLOUD = ObjectCloud(5, np.zeros((64, 3), np.float32), np.zeros(64, np.float32),
                    Pose(9, np.zeros(3), np.array([0.0, 0, 0, 1])), 1, 9, 3.0, 60, True, np.zeros(3))  # fmt: skip
CAR = Shape(5, "car", {"car": 1.0}, 0.9, np.ones((100, 3), np.float32), np.ones((9, 3), np.float32), CLOUD, "0" * 16)


def publish(endpoint: str, shapes: list[Shape], done: threading.Event) -> None:
    """Send the shapes again and again until the listener has enough."""
    with Publisher(StreamSettings((endpoint,)), bytes(8), bytes(8), "sim") as sender:
        while not done.wait(0.02):
            for shape in shapes:
                sender.shape(shape)


def listen(folder: Path, shapes: list[Shape]) -> list[str]:
    """Names of the files after one start of a publisher."""
    endpoint, done = f"ipc://{folder.parent}/pub", threading.Event()
    thread = threading.Thread(target=publish, args=(endpoint, shapes, done))
    thread.start()
    options = ("--endpoint", endpoint, "--save", folder, "--topic", "shape", "--count", len(shapes), "--timeout", "20")
    outcome = rfconstruct("listen", *options)
    done.set()
    thread.join()
    assert outcome.code == ExitCode.OK
    return sorted(path.name for path in folder.iterdir())


def test_restarts_and_classes_overwrite_nothing(tmp_path: Path) -> None:
    shapes = [CAR, replace(CAR, class_name="unknown")]
    first = listen(tmp_path / "saved", shapes)
    both = listen(tmp_path / "saved", shapes)
    assert len(first) == 2
    assert len(both) == 4
    assert set(first) < set(both)
    assert all(name.startswith("shape_") and "_5_9_" in name for name in both)
    assert len({name.split("_")[1] for name in both}) == 2, "one prefix for every start of the publisher"


@pytest.mark.parametrize("name", ["car", "../../etc/passwd", "a b"])
def test_names_stay_in_their_folder_and_are_free(tmp_path: Path, name: str) -> None:
    class Head:
        boot, t_ns, sequence = bytes(range(16)), 9, 7

    message = ShapeMessage(Head(), 5, name, *[None] * 13)  # type: ignore[arg-type]
    for count in range(1, 4):
        path = free_path(tmp_path, message)
        assert path.parent == tmp_path
        path.write_bytes(b"")
        assert len(list(tmp_path.iterdir())) == count
    assert (tmp_path / "shape_00010203_car_5_9_7_3.ply").exists() == (name == "car")
