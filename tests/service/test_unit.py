# SPDX-License-Identifier: Apache-2.0
"""The unit and its companions: keys by a plain parser, exposure by systemd-analyze, names that agree with the code."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from edge.odometry.oak_child import OFFLINE
from edge.stream.keys import DEFAULT_FOLDER

ROOT = Path(__file__).resolve().parents[2]
SYSTEMD = ROOT / "systemd"
UNIT = SYSTEMD / "rfconstruct.service"
HIGHEST_EXPOSURE = 20
"""Tenths, as systemd-analyze counts its threshold."""


def parsed(text: str) -> dict[str, dict[str, list[str]]]:
    """Sections, keys and all their values in order; as plain as systemd.syntax(7) without continuation lines."""
    sections: dict[str, dict[str, list[str]]] = {}
    for line in text.splitlines():
        if not line.strip() or line.startswith(("#", ";")):
            continue
        if match := re.fullmatch(r"\[(\w+)\]", line):
            section = sections.setdefault(match[1], {})
            continue
        key, value = re.fullmatch(r"([A-Za-z]+)=(.*)", line).groups()  # type: ignore[union-attr]
        section.setdefault(key, []).append(value)
    return sections


@pytest.fixture(scope="module")
def service() -> dict[str, list[str]]:
    return parsed(UNIT.read_text(encoding="utf-8"))["Service"]


def test_sections_and_limits_of_restarts() -> None:
    unit = parsed(UNIT.read_text(encoding="utf-8"))
    assert list(unit) == ["Unit", "Service", "Install"]
    assert (unit["Unit"]["StartLimitIntervalSec"], unit["Unit"]["StartLimitBurst"]) == (["300"], ["10"])
    assert unit["Install"]["WantedBy"] == ["multi-user.target"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("Type", "notify"),
        ("NotifyAccess", "main"),
        ("WatchdogSec", "10"),
        ("Restart", "always"),
        ("RestartPreventExitStatus", "2 5 6"),
        ("User", "rfconstruct"),
        ("UMask", "0077"),
        ("ProtectSystem", "strict"),
        ("CapabilityBoundingSet", ""),
        ("NoNewPrivileges", "yes"),
        ("IPAddressDeny", "any"),
        ("LimitCORE", "0"),
        ("MemoryMax", "4G"),
    ],
)
def test_what_the_unit_must_say(service: dict[str, list[str]], key: str, value: str) -> None:
    assert service[key] == [value]


def test_numba_may_execute_what_it_wrote(service: dict[str, list[str]]) -> None:
    assert "MemoryDenyWriteExecute" not in service


def test_depthai_is_told_to_be_silent_before_it_starts(service: dict[str, list[str]]) -> None:
    set_ = dict(pair.split("=", 1) for line in service["Environment"] for pair in line.split(" ") if "=" in pair)
    for name, value in OFFLINE.items():
        assert set_[name] == value


def test_the_clock_can_be_read_though_it_cannot_be_set(service: dict[str, list[str]]) -> None:
    """``utc_ok`` asks the kernel by adjtimex, which ProtectClock= would forbid."""
    assert service["SystemCallFilter"][-1] == "adjtimex clock_adjtime"
    assert "ProtectClock" not in service


def test_exposure() -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze here: apt-get install systemd")
    command = ["systemd-analyze", "security", "--offline=true", f"--threshold={HIGHEST_EXPOSURE}", "--no-pager", UNIT]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert answer.returncode == 0, answer.stdout[-200:] + answer.stderr
    assert "Unknown" not in answer.stderr


def test_users_and_folders_agree_with_the_unit_and_the_code(service: dict[str, list[str]]) -> None:
    users = (SYSTEMD / "sysusers" / "rfconstruct.conf").read_text(encoding="utf-8")
    assert re.search(r"^u\s+rfconstruct\s+-\s+\"[^\"]+\"\s+/var/lib/rfconstruct$", users, re.MULTILINE)
    assert re.search(r"^m\s+rfconstruct\s+dialout$", users, re.MULTILINE)
    lines = (SYSTEMD / "tmpfiles" / "rfconstruct.conf").read_text(encoding="utf-8").splitlines()
    modes = {line.split()[1]: line.split()[2:5] for line in lines if line and not line.startswith("#")}
    assert modes[str(DEFAULT_FOLDER)] == ["0700", "rfconstruct", "rfconstruct"]
    assert modes["/var/lib/rfconstruct"][0] == service["StateDirectoryMode"][0]
    assert modes["/var/cache/rfconstruct"][0] == service["CacheDirectoryMode"][0]
    rules = (SYSTEMD / "udev" / "60-rfconstruct.rules").read_text(encoding="utf-8")
    assert set(re.findall(r'GROUP="(\w+)"', rules)) == {"dialout"}


def test_receive_buffers_hold_a_third_of_a_second_of_a_capture_card() -> None:
    text = (SYSTEMD / "sysctl" / "60-rfconstruct.conf").read_text(encoding="utf-8")
    found = re.search(r"^net\.core\.rmem_max = (\d+)$", text, re.MULTILINE)
    assert found
    assert int(found[1]) >= 0.3 * 100e6


@pytest.mark.parametrize(
    ("tool", "file"),
    [("systemd-sysusers", "sysusers/rfconstruct.conf"), ("systemd-tmpfiles", "tmpfiles/rfconstruct.conf")],
)
def test_systemd_itself_accepts_users_and_folders(tool: str, file: str, tmp_path: Path) -> None:
    if shutil.which(tool) is None:
        pytest.skip(f"no {tool} here: apt-get install systemd")
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")
    (tmp_path / "etc" / "group").write_text("root:x:0:\ndialout:x:20:\n")
    users = ["systemd-sysusers", f"--root={tmp_path}", str(SYSTEMD / "sysusers" / "rfconstruct.conf")]
    subprocess.run(users, capture_output=True, timeout=60, check=True)
    assert "rfconstruct" in (tmp_path / "etc" / "passwd").read_text()
    assert re.search(r"^dialout:.*rfconstruct$", (tmp_path / "etc" / "group").read_text(), re.MULTILINE)
    if tool == "systemd-tmpfiles":
        folders = [tool, "--create", f"--root={tmp_path}", str(SYSTEMD / file)]
        answer = subprocess.run(folders, capture_output=True, text=True, timeout=60, check=False)
        assert (tmp_path / str(DEFAULT_FOLDER).lstrip("/")).stat().st_mode & 0o777 == 0o700, answer.stderr
