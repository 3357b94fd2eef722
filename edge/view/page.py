# SPDX-License-Identifier: Apache-2.0
"""The web page: viser's server on this machine's loopback, panels, switches, and the scrubber of a recording."""

from __future__ import annotations

import contextlib
import io
import socket
import time
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from edge.errors import ConfigError, DependencyError
from edge.frames import RADARS, RadarId
from edge.view import canvas
from edge.view.health import Banner
from edge.view.panels import account_html, banner_html, classes_html
from edge.view.playback import SPEEDS, Player
from edge.view.scene import Drawables, Scene
from edge.view.stage import TALLEST_M, Look, Stage

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
DEFAULT_PORT = 8080
PICTURES_PERIOD_S = 0.25
TEXT_PERIOD_S = 0.5
SHORTEST_KEEP_S, LONGEST_KEEP_S = 5.0, 300.0
LEFT_PX, RIGHT_PX = 400.0, 350.0
_EMPTY = np.full((20, canvas.WIDTH, 3), canvas.PAPER, np.uint8)


class Page:
    """The page, served until ``close``.

    Args:
        port: of 127.0.0.1; 0: any free one.
        title: what is shown, for the panel's label.
        player: of a recording, for the scrubber; None: a live stream.
    Raises:
        ConfigError: the port is taken.
        DependencyError: viser is not installed.
    """

    def __init__(self, port: int = DEFAULT_PORT, title: str = "RFconstruct", player: Player | None = None) -> None:
        self.look = Look()
        self.keep_s = 30.0
        self._player = player
        self._server = _serve(port, title)
        self._server.request_share_url = _refuse_to_share  # type: ignore[method-assign]
        gui = self._server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(92, 160, 255))
        gui.set_panel_label(title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(RIGHT_PX)
        self._stage = Stage(self._server)
        self._banner = gui.add_html("")
        self._scrubber: Any = None
        if player is not None:
            self._add_player(player)
        self._add_switches()
        self._account = gui.add_html("")
        self._pictures = self._add_pictures()
        self._painters = {radar: canvas.HeatmapPainter() for radar in RADARS}
        self._painted: dict[str, object] = {}
        self._pictures_due_s = self._text_due_s = 0.0
        self._aimed = False

    @property
    def port(self) -> int:
        """That the browser connects to."""
        return int(self._server.get_port())

    @property
    def url(self) -> str:
        """Of the page."""
        return f"http://{HOST}:{self.port}"

    @property
    def server(self) -> viser.ViserServer:
        """Viser's own handle."""
        return self._server

    def update(self, scene: Scene, banner: Banner, figures: Mapping[str, str], wall_s: float) -> None:
        """Show the scene at ``wall_s``; call ten times a second.

        Args:
            scene: the model.
            banner: state of the stream.
            figures: name -> value, below the account of frames.
            wall_s: the scene's clock.
        """
        now_s = time.monotonic()
        scene.keep_s = self.keep_s
        drawn = scene.drawables(wall_s)
        self._stage.draw(drawn, self.look)
        if not self._aimed:
            self._aimed = self._aim(drawn)
        self._set(self._banner, "content", banner_html(banner))
        if self._player is not None:
            self._update_player(self._player)
        if now_s >= self._text_due_s:
            self._text_due_s = now_s + TEXT_PERIOD_S
            self._set(self._account, "content", account_html(scene.health.status, figures))
        if now_s >= self._pictures_due_s:
            self._pictures_due_s = now_s + PICTURES_PERIOD_S
            self._paint(scene, wall_s)

    def close(self) -> None:
        """End the server."""
        with contextlib.redirect_stdout(io.StringIO()):  # viser says on stdout that it ended
            self._server.stop()

    def _aim(self, drawn: Drawables) -> bool:
        """Put every camera behind the vehicle; False: nobody knows yet where it is."""
        view = self._stage.camera_for(drawn)
        if view is None:
            return False
        cameras: list[Any] = [self._server.initial_camera, *(c.camera for c in self._server.get_clients().values())]
        for camera in cameras:
            camera.position, camera.look_at = view
        return True

    def _add_player(self, player: Player) -> None:
        gui = self._server.gui
        with gui.add_folder("Recording"):
            self._scrubber = gui.add_slider("position, s", 0.0, 1.0, 0.05, 0.0)
            self._play = gui.add_button_group("playing", ("play", "pause"))
            speed = gui.add_dropdown("speed", [f"{s:g}x" for s in SPEEDS], initial_value="1x")
        self._scrubber.on_update(lambda event: player.seek(event.target.value) if event.client is not None else None)
        self._play.on_click(lambda event: player.play(event.target.value == "play"))
        speed.on_update(lambda event: player.set_speed(float(event.target.value.rstrip("x"))))

    def _update_player(self, player: Player) -> None:
        """The scrubber follows the clock; a change by the server is no jump."""
        length_s = max(round(player.length_s, 2), 0.1)
        self._set(self._scrubber, "max", length_s)
        position_s = min(round(player.position_s, 2), length_s)
        if abs(self._scrubber.value - position_s) >= 0.04:
            self._scrubber.value = position_s
        self._set(self._play, "label", "playing" if player.playing else "paused")

    def _add_switches(self) -> None:
        gui, look = self._server.gui, self.look
        with gui.add_folder("Show"):
            cloud = gui.add_dropdown("cloud by", ("height", "power"), initial_value=look.cloud)
            self._legend = gui.add_image(_EMPTY)
            shapes = gui.add_dropdown("shapes by", ("class", "confidence"), initial_value=look.shapes)
            gui.add_html(classes_html())
            names = {
                "show_cloud": "fused cloud",
                "show_shapes": "shapes",
                "show_boxes": "boxes, labels",
                "show_path": "path",
                "show_points": "newest frame",
                "follow": "follow",
            }
            for name, label in names.items():
                box = gui.add_checkbox(label, initial_value=getattr(look, name))
                box.on_update(partial(_switch, look, name))
            size = gui.add_slider("point size, cm", 1.0, 20.0, 1.0, 100.0 * look.point_m)
            keep = gui.add_slider("objects stay, s", SHORTEST_KEEP_S, LONGEST_KEEP_S, 5.0, self.keep_s)
            camera = gui.add_button("look along the radars")
        cloud.on_update(lambda event: setattr(look, "cloud", event.target.value))
        shapes.on_update(lambda event: setattr(look, "shapes", event.target.value))
        size.on_update(lambda event: setattr(look, "point_m", event.target.value / 100.0))
        keep.on_update(lambda event: setattr(self, "keep_s", event.target.value))
        camera.on_click(lambda event: setattr(self, "_aimed", False))

    def _add_pictures(self) -> dict[str, Any]:
        """A panel at the left: both heatmaps and the strips."""
        gui = self._server.gui
        panel = gui.add_panel()
        with panel.add_tab("Radars"):
            pictures: dict[str, Any] = {radar: gui.add_image(_EMPTY, jpeg_quality=85) for radar in RADARS}
            pictures["strip"] = gui.add_image(_EMPTY, jpeg_quality=90)
        panel.dock_left()
        panel.set_width(LEFT_PX)
        return pictures

    def _paint(self, scene: Scene, wall_s: float) -> None:
        """Pictures whose content is another than at the last time."""
        for radar in RADARS:
            self._paint_heatmap(scene, radar)
        history = scene.health.history
        if self._new("strip", (scene.generation, len(history), round(wall_s, 0))):
            self._pictures["strip"].image = canvas.strip(list(history), wall_s)
        cloud, (low_db, high_db) = self.look.cloud, self._stage.power_db
        if self._new("legend", (cloud, low_db, high_db)):
            ends = ("0 m", f"{TALLEST_M:g} m") if cloud == "height" else (f"{low_db:.0f} dB", f"{high_db:.0f} dB")
            title = "height above the ground" if cloud == "height" else "power"
            self._legend.image = canvas.legend(title, *ends)

    def _paint_heatmap(self, scene: Scene, radar: RadarId) -> None:
        heatmap, detections = scene.heatmaps.get(radar), scene.detections
        found = None if detections is None else getattr(detections, radar)
        if not self._new(radar, (scene.generation, heatmap and heatmap.number, found and found.number)):
            return
        self._pictures[radar].image = _EMPTY if heatmap is None else self._painters[radar].paint(heatmap, found)

    def _new(self, name: str, content: object) -> bool:
        if self._painted.get(name) == content:
            return False
        self._painted[name] = content
        return True

    @staticmethod
    def _set(handle: Any, name: str, value: object) -> None:
        """Assign a property unless it has the value: every assignment is sent."""
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def _serve(port: int, title: str) -> viser.ViserServer:
    """Viser on loopback at this very port: by itself it would take the next free one."""
    try:
        import viser
    except ImportError as error:
        raise DependencyError("the viewer needs viser", action="pip install 'rfconstruct[view]'") from error
    if port:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError as error:
                raise _taken(port, error.strerror or "") from error
    with contextlib.redirect_stdout(io.StringIO()):  # viser writes its addresses there
        server = viser.ViserServer(HOST, port, label=title, verbose=False)
        if port and server.get_port() != port:
            server.stop()
            raise _taken(port, "taken meanwhile")
    return server


def _switch(look: Look, name: str, event: Any) -> None:
    setattr(look, name, event.target.value)


def _taken(port: int, why: str) -> ConfigError:
    return ConfigError(f"port {port} of {HOST} cannot be bound ({why})", action="choose another with --port")


def _refuse_to_share(verbose: bool = True) -> str | None:
    """Viser would ask a server on the internet for a public address when a page asks it to; this viewer never does."""
    return cast("str | None", None)
