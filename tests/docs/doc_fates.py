# SPDX-License-Identifier: Apache-2.0
"""What becomes of each command of the documents: it runs here, another test runs it, or it cannot be run, and why."""

from __future__ import annotations

import re

from doc_commands import Command

HERE = re.compile(
    r"rfconstruct (?:info|replay results\.mcap|replay raw\.mcap|export results\.mcap|listen"
    r"|record results\.mcap --results|run .*--dry-run|keys|doctor$)|mkdir |cp -r "
    r"|rfconstruct-train objects (?:import|list)"
)
"""Commands that run here, in a folder with two small recordings, two boards files and two meshes."""

ELSEWHERE: tuple[tuple[str, str, str], ...] = (
    ("docs/client.md", r"rfconstruct (?:demo|listen|view)|python ", "tests/examples/test_client_document.py"),
    ("docs/client.md", r"g\+\+|\./subscriber", "tests/examples/test_cpp_subscriber.py"),
    ("docs/recordings.md", r"rfconstruct (?:info|replay|recover|export)", "tests/cli/test_recordings_doc.py"),
    ("docs/service.md", r"rfconstruct keys", "tests/service/test_service_doc.py"),
    ("docs/service.md", r"systemd-analyze|find", "tests/service/test_service_doc.py"),
    ("docs/service.md", r"packaging/build_deb.sh", "tests/packaging/test_deb.py"),
    ("docs/own_data.md", r"rfconstruct-train (?!objects import|objects list)", "tests/docs/test_own_data.py"),
    ("", r"rfconstruct view", "tests/view/test_view_command.py"),
    ("", r"rfconstruct calibrate", "tests/cli/test_calibrate_cli.py"),
    ("", r"rfconstruct doctor --hardware", "tests/cli/test_doctor_hardware.py"),
    ("", r"rfconstruct run", "tests/cli/test_run_command.py"),
    ("", r"rfconstruct record \S+ --rig", "tests/cli/test_record.py"),
    ("", r"rfconstruct bench", "tests/test_bench.py"),
    ("", r"python examples/", "tests/examples/test_client_examples.py"),
    ("", r"rfconstruct-train street", "tests/simulate/test_street.py"),
    ("", r"rfconstruct-train simulate", "tests/simulate/test_simulate_command.py"),
    ("", r"rfconstruct-train montage", "tests/simulate/test_montage.py"),
    ("", r"rfconstruct-train rig", "tests/simulate/test_virtual_rig.py"),
    ("", r"rfconstruct-train bench-completion", "tests/train/test_bench_completion.py"),
    ("", r"rfconstruct-train bench", "tests/simulate/test_simulate_bench.py"),
    ("", r"rfconstruct-train fit|torchrun .*train.cli fit", "tests/train/test_fit.py"),
    ("", r"rfconstruct-train evaluate", "tests/train/test_evaluate.py"),
    ("", r"rfconstruct-train export", "tests/train/test_export.py"),
)
"""Page (empty: any), command, and the test that runs that command or verb."""

NOWHERE: tuple[tuple[str, str], ...] = (
    (r"rfconstruct replay \$RFCONSTRUCT_DATA", "needs the public recording: tests/cli/test_corridor_cli.py"),
    (r"make", "makes a virtual environment; its targets are looked up"),
    (r"\. |export ", "changes the reader's shell"),
    (r"pytest", "the tests themselves, or boards"),
    (r"ssh|curl|ls /dev|systemctl|journalctl|echo", "needs an appliance or its boards"),
    (r"python -m edge.bench.studies", "a measurement of a minute"),
)
"""Command and why no test runs it."""


def fate(command: Command) -> str:
    """ "here", the test that runs it, or the reason why none does. ValueError: nobody has decided."""
    text = " ".join(command.words)
    if command.as_root:
        return "changes the system"
    for page, pattern, test in ELSEWHERE:
        if page and page == command.page and re.match(pattern, text):
            return test
    if HERE.match(text):
        return "here"
    for page, pattern, test in ELSEWHERE:
        if not page and re.match(pattern, text):
            return test
    for pattern, reason in NOWHERE:
        if re.match(pattern, text):
            return reason
    raise ValueError(f"{command}: say in {__name__}.py whether it runs in a test, and which, or why it cannot")
