# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct doctor --hardware``: each broken set-up of the virtual rig is named, with the next step."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from cli_run import Outcome, rfconstruct
from virtual_boards import Virtual, virtual_boards

from edge.commands import doctor_hardware, network_checks
from edge.commands.checks import Check
from edge.errors import ExitCode, LinkError


@pytest.fixture(autouse=True)
def _short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses of the virtual rig begin with the frames: where none are taken nobody needs to wait."""
    monkeypatch.setattr(doctor_hardware, "POSES_S", 0.2)


def doctor(virtual: Virtual, *words: object, rig: str = "") -> Outcome:
    return rfconstruct("doctor", "--hardware", "--rig", rig or virtual.rig.name, "--boards", virtual.boards, *words)


def checks(outcome: Outcome) -> dict[str, dict[str, Any]]:
    found = {check["name"]: check for check in outcome.json["checks"]}
    assert outcome.json["exit_code"] == outcome.code
    return found


def dead(virtual: Virtual, name: str, *words: object, rig: str = "") -> str:
    """The one failing check is this one; what it says, and to do."""
    outcome = doctor(virtual, "--json", *words, rig=rig)
    assert outcome.code == ExitCode.NO_HARDWARE
    failing = {key: check for key, check in checks(outcome).items() if check["outcome"] == "fails"}
    assert name in failing, failing
    assert failing[name]["action"]
    return f"{failing[name]['found']} -> {failing[name]['action']}"


@pytest.mark.parametrize("name", ["awr1843_pair", "cascade_pair"])
def test_everything_in_order(name: str, tmp_path: Path) -> None:
    with virtual_boards(name, tmp_path) as virtual:
        outcome = doctor(virtual)
        assert virtual.violations == []
    assert outcome.code == ExitCode.OK, outcome.out
    assert outcome.out.endswith("the hardware is ready\n")
    assert "vertical frames" in outcome.out
    assert "fails" not in outcome.out


def test_no_power(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(*_: object, **__: object) -> socket.socket:
        raise TimeoutError("timed out")

    table = tmp_path / "arp"
    table.write_text("IP HW Flags MAC Mask Dev\n127.0.0.1 0x1 0x0 00:00:00:00:00:00 * e\n")
    monkeypatch.setattr(network_checks, "NEIGHBOURS", table)
    with virtual_boards("cascade_pair", tmp_path) as virtual, monkeypatch.context() as silent:
        silent.setattr(network_checks.socket, "create_connection", nobody)
        said = dead(virtual, "vertical control port", "--quick")
    assert "no device on the cable has this address" in said
    assert "supply" in said
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        virtual.parts.unplug("horizontal")
        said = dead(virtual, "horizontal card", "--quick")
    assert "power (5 V)" in said


def test_wrong_port(tmp_path: Path) -> None:
    with virtual_boards("cascade_pair", tmp_path) as virtual, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = virtual.parts.boards["horizontal"].address[1]
        text = virtual.boards.read_text().replace(f"control_port = {port}", f"control_port = {free.getsockname()[1]}")
        virtual.boards.write_text(text)
        assert "refuses port" in dead(virtual, "horizontal control port", "--quick")


def test_another_client(tmp_path: Path) -> None:
    with virtual_boards("cascade_pair", tmp_path) as virtual:
        client = socket.create_connection(virtual.parts.boards["horizontal"].address)
        said = dead(virtual, "horizontal greeting", "--quick")
        client.close()
    assert "one host at a time" in said


def test_ports_of_this_host(tmp_path: Path) -> None:
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        target = virtual.parts.cards["vertical"].data_target
        assert target is not None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(target)
            said = dead(virtual, "vertical host ports", "--quick")
        assert "(process" in said
        virtual.boards.write_text(virtual.boards.read_text().replace("127.0.0.31", "192.0.2.31"))
        assert "ip address add" in dead(virtual, "vertical host ports", "--quick")


def test_small_receive_buffer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit = tmp_path / "rmem_max"
    monkeypatch.setattr(network_checks, "RMEM_MAX", limit)
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        limit.write_text("212992\n")
        assert "sysctl -w net.core.rmem_max=16777216" in dead(virtual, "vertical receive buffer", "--quick")
        limit.write_text("4194304\n")
        found = checks(doctor(virtual, "--json", "--quick"))
        assert found["vertical receive buffer"]["outcome"] == "note"


def test_serial_ports(tmp_path: Path) -> None:
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        virtual.faults.set("drop", "vertical/cli")
        assert "SOP" in dead(virtual, "vertical demo", "--quick")
        virtual.faults.clear("drop", None)
        virtual.parts.radars["vertical"].unplug()
        assert "is not there" in dead(virtual, "vertical serial port", "--quick")


def test_the_demo_of_another_device(tmp_path: Path) -> None:
    with virtual_boards("iwr6843_pair", tmp_path) as virtual:
        said = dead(virtual, "horizontal demo", "--quick", rig="awr1843_pair")
    assert "xWR68" in said
    assert "AWR1843" in said


def test_no_frames(tmp_path: Path) -> None:
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        virtual.faults.set("drop", "horizontal/frames")
        said = dead(virtual, "horizontal frames")
    assert "no samples" in said
    assert "60-pin" in said


def test_no_poses(tmp_path: Path) -> None:
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        virtual.parts.unplug("pose")
        assert "none within" in dead(virtual, "poses")


def test_firmware_file(tmp_path: Path) -> None:
    with virtual_boards("cascade_pair", tmp_path) as virtual:
        image = tmp_path / "boards.firmware.bin"
        image.write_bytes(image.read_bytes()[:-1] + b"\1")
        assert "CRC-32" in dead(virtual, "horizontal firmware file", "--quick")
        image.unlink()
        assert "MMWAVE-DFP" in dead(virtual, "vertical firmware file", "--quick")


def test_recordings_out_of_reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with virtual_boards("cascade_pair", tmp_path) as virtual:
        virtual.boards.write_text(virtual.boards.read_text().replace('fetch = "folder"', 'fetch = "ssh"'))
        monkeypatch.setenv("PATH", str(tmp_path))
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
        assert "openssh-client" in dead(virtual, "horizontal recordings", "--quick")


def test_two_boards_at_one_address(tmp_path: Path) -> None:
    boards = tmp_path / "boards.toml"
    boards.write_text('[radars.vertical.board]\naddress = "192.168.33.180"\n')
    outcome = rfconstruct("doctor", "--hardware", "--rig", "cascade_pair", "--boards", boards)
    assert outcome.code == ExitCode.NO_HARDWARE
    assert "share one control address" in outcome.out


def test_keys_of_the_rig_are_looked_at_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = Check("keys", "fails", "server.key_secret is open to others (mode 0644)", "chmod 600")
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        assert checks(doctor(virtual, "--json", "--quick"))["keys"]["outcome"] == "ok"
        monkeypatch.setattr(doctor_hardware, "keys_check", lambda stream: wrong)
        virtual.boards.write_text(virtual.boards.read_text().replace('kind = "zmq"', 'kind = "none"'))
        told = doctor(virtual, "--quick")
    assert told.code == ExitCode.DEGRADED, told.out
    assert "open to others" in told.out
    assert told.out.endswith("the hardware is ready, the keys are not\n")


def test_rig_is_needed() -> None:
    outcome = rfconstruct("doctor", "--hardware")
    assert outcome.code == ExitCode.BAD_CONFIG
    assert "--rig" in outcome.err


ROUTES = """Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT
eth1 0021A8C0 00000000 0001 0 0 0 00FFFFFF 0 0 0
eth0 00000000 0100A8C0 0003 0 0 0 00000000 0 0 0
"""


def test_the_way_to_a_board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Probe:
        def __enter__(self) -> Probe:
            return self

        def __exit__(self, *_: object) -> None: ...
        def connect(self, address: object) -> None: ...
        def getsockname(self) -> tuple[str, int]:
            return "192.168.33.30", 1

    routes = tmp_path / "route"
    routes.write_text(ROUTES)
    monkeypatch.setattr(network_checks, "ROUTES", routes)
    monkeypatch.setattr(network_checks.socket, "socket", lambda *_: Probe())
    assert network_checks.way_to("192.168.33.180") == "from 192.168.33.30 by eth1"
    with pytest.raises(LinkError, match="to a router") as caught:
        network_checks.way_to("10.1.2.3")
    assert "10.1.2.30/24" in caught.value.action


def test_the_neighbour_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = tmp_path / "arp"
    table.write_text("IP HW Flags MAC Mask Dev\n10.0.0.1 0x1 0x0 00:00:00:00:00:00 * e\n10.0.0.2 0x1 0x2 aa:bb * e\n")
    monkeypatch.setattr(network_checks, "NEIGHBOURS", table)
    assert network_checks.neighbour("10.0.0.1").startswith("no device")
    assert "aa:bb" in network_checks.neighbour("10.0.0.2")
    assert network_checks.neighbour("10.0.0.3") == ""
