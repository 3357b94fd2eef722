# SPDX-License-Identifier: Apache-2.0
"""Draws the scene's drawables with viser; a node is sent again only when what it shows has changed."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from edge.frames import Float32, Float64, Pose
from edge.view.colours import Colours, Rgb, class_colour, faded, ramp, ramp_colour, shaded
from edge.view.scene import Drawables, Thing, Window, boresight_rad, object_label

if TYPE_CHECKING:
    import viser

TALLEST_M = 2.5
"""Heights above the ground from 0 to this fill the ramp."""
OLDER_WINDOW = 0.5
"""Strength of all windows but the newest."""
PATH_COLOUR: Rgb = (120, 132, 156)
RIG_COLOUR: Rgb = (240, 200, 80)
POINT_COLOUR: Rgb = (255, 255, 255)
CAMERA_BACK_M, CAMERA_UP_M, LOOK_AHEAD_M = 6.0, 4.2, 2.5


@dataclass(slots=True)
class Look:
    """What the user chose.

    Args:
        cloud: colour of the fused clouds.
        shapes: colour of the shapes.
        show_cloud, show_shapes, show_boxes, show_path, show_points: what is drawn.
        follow: the scene moves under the vehicle; otherwise the vehicle moves through the scene.
        point_m: size of the fused points.
    """

    cloud: Literal["height", "power"] = "height"
    shapes: Literal["class", "confidence"] = "class"
    show_cloud: bool = True
    show_shapes: bool = True
    show_boxes: bool = True
    show_path: bool = True
    show_points: bool = True
    follow: bool = True
    point_m: float = 0.05


class Stage:
    """The three-dimensional part of the page.

    Args:
        server: viser's.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self._scene.set_up_direction("+z")
        self._scene.configure_default_lights(True, cast_shadow=False)
        self._scene.configure_environment_map(None)  # it and shadows cost a computer without GPU more than they show
        self._scene.add_light_ambient("/light", intensity=1.5)
        self._root = self._scene.add_frame("/world", show_axes=False)
        self._scene.add_grid(
            *("/grid",),
            infinite_grid=True,
            cell_size=1.0,
            section_size=5.0,
            cell_color=(58, 62, 74),
            section_color=(92, 98, 114),
            fade_distance=60.0,
            shadow_opacity=0.0,
        )
        self._nodes: dict[str, tuple[Hashable, Any]] = {}
        self._generation = -1
        self.power_db = (0.0, 1.0)
        """Range of the power's colours."""

    def draw(self, drawn: Drawables, look: Look) -> None:
        """Show this, and only this."""
        if drawn.generation != self._generation:
            self._clear(set())
            self._generation = drawn.generation
        kept: set[str] = set()
        with self._server.atomic():
            self._vehicle(drawn, look, kept)
            if look.show_cloud:
                self._clouds(drawn, look, kept)
            if look.show_points and len(drawn.points_m):
                kept.add("/world/points")
                key = (drawn.points_m.tobytes(), look.point_m)
                self._points("/world/points", drawn.points_m, POINT_COLOUR, 1.6 * look.point_m, key)
            for thing, strength in drawn.things:
                self._thing(thing, strength, look, kept)
            self._clear(kept)

    def camera_for(self, drawn: Drawables) -> tuple[Float64, Float64] | None:
        """Place of a camera behind the vehicle that looks along the radars, and what it looks at; None: no pose yet."""
        if drawn.vehicle is None:
            return None
        angle = boresight_rad(drawn.vehicle)
        ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
        turn = np.radians(28.0)
        back = np.array([np.cos(angle + turn), np.sin(angle + turn), 0.0])
        ground = drawn.vehicle.position_m * [1.0, 1.0, 0.0] + [0.0, 0.0, drawn.ground_m] + self._root.position
        return ground - CAMERA_BACK_M * back + [0.0, 0.0, CAMERA_UP_M], ground + LOOK_AHEAD_M * ahead

    def _vehicle(self, drawn: Drawables, look: Look, kept: set[str]) -> None:
        pose = drawn.vehicle
        if pose is None:
            return
        if look.follow:
            self._root.position = (-pose.position_m[0], -pose.position_m[1], -drawn.ground_m)
        if look.show_path and drawn.path_m:
            kept.add("/world/path")
            self._path(drawn.path_m, drawn.ground_m)
        kept |= {"/world/rig", "/world/vehicle"}
        self._place_rig(pose)
        self._place_vehicle(pose, drawn.heading_rad, drawn.ground_m)

    def _place_rig(self, pose: Pose) -> None:
        """Both boards as a small box, and a ray along their boresight."""
        if self._changed("/world/rig", ()):
            frame = self._scene.add_frame("/world/rig", show_axes=False)
            self._scene.add_box("/world/rig/boards", color=RIG_COLOUR, dimensions=(0.12, 0.34, 0.34))
            ray = np.array([[[0.06, 0.0, 0.0], [1.5, 0.0, 0.0]]])
            self._scene.add_line_segments("/world/rig/boresight", ray, RIG_COLOUR, thickness=0.03)
            self._nodes["/world/rig"] = ((), frame)
        frame = self._nodes["/world/rig"][1]
        frame.position = tuple(pose.position_m)
        frame.wxyz = tuple(pose.quaternion_xyzw[[3, 0, 1, 2]])

    def _place_vehicle(self, pose: Pose, heading_rad: float | None, ground_m: float) -> None:
        """An arrow on the ground below the rig: the stream does not say what vehicle it is."""
        if self._changed("/world/vehicle", ()):
            corners = np.array([[1.6, 0, 0], [-1.2, 0.8, 0], [-0.7, 0, 0], [-1.2, -0.8, 0]], np.float32)
            faces = np.array([[0, 1, 2], [0, 2, 3]])
            arrow = self._scene.add_mesh_simple(
                "/world/vehicle", corners, faces, color=RIG_COLOUR, opacity=0.75, side="double"
            )
            self._scene.add_label("/world/vehicle/name", "vehicle", position=(-1.5, 0.0, 0.1), font_screen_scale=0.9)
            self._nodes["/world/vehicle"] = ((), arrow)
        arrow = self._nodes["/world/vehicle"][1]
        angle = boresight_rad(pose) if heading_rad is None else heading_rad
        arrow.position = (pose.position_m[0], pose.position_m[1], ground_m + 0.03)
        arrow.wxyz = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))

    def _path(self, pieces: list[Float32], ground_m: float) -> None:
        last = pieces[-1][-1]
        key = (len(pieces), sum(map(len, pieces)), round(float(last[0]), 1), round(float(last[1]), 1), ground_m)
        if not self._changed("/world/path", key):
            return
        segments = np.concatenate([np.stack([piece[:-1], piece[1:]], axis=1) for piece in pieces])
        segments[..., 2] = ground_m + 0.02
        line = self._scene.add_line_segments("/world/path", segments, PATH_COLOUR, thickness=0.06)
        self._nodes["/world/path"] = (key, line)

    def _clouds(self, drawn: Drawables, look: Look, kept: set[str]) -> None:
        if not drawn.windows:
            return
        power_db = np.concatenate([window.power_db for window in drawn.windows])
        low, high = np.percentile(power_db, (5, 95)) if look.cloud == "power" else (0.0, 1.0)
        self.power_db = (float(np.floor(low)), float(max(np.ceil(high), np.floor(low) + 1)))
        for window in drawn.windows:
            name = f"/world/windows/{window.number}"
            kept.add(name)
            strength = 1.0 if window is drawn.windows[-1] else OLDER_WINDOW
            ground_m = round(drawn.ground_m, 1)
            key = (look.cloud, self.power_db, strength, look.point_m, ground_m)
            if self._changed(name, key):
                colours = faded(self._window_colours(window, look, ground_m), strength)
                self._points(name, window.points_m, colours, look.point_m, key, window.center_m)

    def _window_colours(self, window: Window, look: Look, ground_m: float) -> Colours:
        if look.cloud == "power":
            return ramp(window.power_db, *self.power_db)
        return ramp(window.points_m[:, 2] + (window.center_m[2] - ground_m), 0.0, TALLEST_M)

    def _thing(self, thing: Thing, strength: float, look: Look, kept: set[str]) -> None:
        name = f"/world/things/{thing.identity}"
        plain = class_colour(thing.class_name) if look.shapes == "class" else ramp_colour(thing.confidence)
        key = (thing.version, strength, look.shapes)
        if look.show_shapes:
            kept.add(f"{name}/shape")
            colours = faded(shaded(plain, thing.points_m[:, 2]), strength)
            self._points(f"{name}/shape", thing.points_m, colours, 0.03, key, thing.box.center_m)
        if look.show_boxes:
            kept |= {f"{name}/box", f"{name}/label"}
            if self._changed(f"{name}/box", key):
                edges = np.concatenate([thing.box.edges(), _pole(thing)[None]])
                lines = self._scene.add_line_segments(f"{name}/box", edges, faded(plain, strength), thickness=0.025)
                self._nodes[f"{name}/box"] = (key, lines)
            if self._changed(f"{name}/label", key):
                label = self._scene.add_label(
                    f"{name}/label",
                    object_label(thing),
                    position=tuple(_pole(thing)[1]),
                    anchor="bottom-center",
                    font_screen_scale=0.9,
                )
                self._nodes[f"{name}/label"] = (key, label)

    def _points(
        self,
        name: str,
        points_m: Float32,
        colours: Colours | Rgb,
        size_m: float,
        key: Hashable,
        center_m: Float64 | None = None,
    ) -> None:
        """A point cloud around its centre: float16 on the way keeps millimetres within a few metres of it."""
        if not self._changed(name, key):
            return
        if center_m is None:
            center_m = points_m.mean(axis=0).astype(np.float64)
            points_m = points_m - center_m.astype(np.float32)
        node = self._scene.add_point_cloud(
            name, points_m, np.asarray(colours), point_size=size_m, point_shape="circle", position=tuple(center_m)
        )
        self._nodes[name] = (key, node)

    def _changed(self, name: str, key: Hashable) -> bool:
        return name not in self._nodes or self._nodes[name][0] != key

    def _clear(self, kept: set[str]) -> None:
        for name in [name for name in self._nodes if name not in kept]:
            self._nodes.pop(name)[1].remove()


def _pole(thing: Thing) -> Float64:
    """From the middle of the box's top to its label, [2, 3]; neighbours' labels are at different heights."""
    top_m = thing.box.center_m + np.array([0.0, 0.0, thing.box.size_m[2] / 2])
    return np.stack([top_m, top_m + np.array([0.0, 0.0, 0.2 + 0.35 * (thing.identity % 3)])])
