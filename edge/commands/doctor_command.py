# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct doctor``: says what on this machine would keep the pipeline from running, and what to do about it."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import re
import socket
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

from edge import numba_cache
from edge.commands.checks import Check, failure, lines
from edge.commands.key_checks import keys_check
from edge.commands.system_checks import buffers, clock, devices
from edge.config import CompletionSettings, StreamSettings
from edge.errors import ExitCode, RfconstructError
from edge.resources import data_dir
from edge.rig import known_rigs, load_rig
from edge.version import version

NAME_WIDTH = 19
OLDEST_PYTHON = (3, 11)
LEAST_MEMORY_GB = 2.0
PACKAGES = ("numpy", "numba", "onnxruntime", "pyzmq", "msgpack", "mcap", "tqdm", "pyserial", "pyusb")
OPTIONAL = {"matplotlib": "plot", "scipy": "import", "depthai": "oak", "viser": "view"}
FAST_CPU = {"x86_64": ("avx2", "fma"), "aarch64": ("asimd",)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("--warm", action="store_true", help="compile the kernels of every shipped rig into the cache")
    parser.add_argument("--hardware", action="store_true", help="follow every link to the boards of --rig instead")
    parser.add_argument("--rig", help="name or folder: whose keys, and with --hardware whose boards")
    parser.add_argument("--boards", type=Path, metavar="FILE", help="with --hardware: where the boards are reached")
    parser.add_argument("--quick", action="store_true", help="with --hardware: configure nothing, take no frames")


def run(args: argparse.Namespace) -> int:
    """Look at everything; exit code 0, or 3 when something fails; with --hardware 4."""
    if args.hardware:
        from edge.commands import doctor_hardware

        return doctor_hardware.run(args)
    steps: list[Callable[[], Check]] = [
        machine,
        cpu_features,
        memory,
        python,
        packages,
        optional_packages,
        rigs,
        model,
        cache,
        *([kernels] if args.warm else []),
        port,
        buffers,
        clock,
        devices,
        _keys(args),
        data,
    ]
    checks: list[Check] = []
    for step in steps:
        check = attempt(step)
        checks.append(check)
        if not args.json:
            print("\n".join(lines(check, NAME_WIDTH)), flush=True)
    failed = [check for check in checks if check.outcome == "fails"]
    code = ExitCode.DEGRADED if failed else ExitCode.OK
    if args.json:
        print(json.dumps({"checks": [asdict(check) for check in checks], "exit_code": int(code)}, indent=2))
    else:
        print(f"{len(failed)} of {len(checks)} checks fail" if failed else "ready")
    return code


def attempt(step: Callable[[], Check]) -> Check:
    """The check's result; whatever it raises is a failure of it, not of the doctor."""
    name = step.__name__.replace("_", " ")
    try:
        return step()
    except RfconstructError as error:
        return failure(name, error, "install rfconstruct again")
    except Exception as error:  # a broken package can raise anything when it is imported
        return Check(name, "fails", f"{type(error).__name__}: {error}", "install rfconstruct again")


def machine() -> Check:
    """Processor and operating system."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    found = f"{numba_cache.processor()}, {count} core{'s' * (count != 1)}, {platform.system()} {platform.release()}"
    if count < 2:
        return Check("machine", "note", found, "two cores keep up with 60 frames/s and the network; one may not")
    return Check("machine", "ok", found)


def cpu_features() -> Check:
    """Vector instructions that the kernels' speed rests on."""
    wanted = FAST_CPU.get(platform.machine(), ())
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    found = re.search(r"^(?:flags|Features)\s*:\s*(.*)$", text, re.MULTILINE)
    flags = set(found[1].split()) if found else set()
    missing = [name for name in wanted if name not in flags]
    best = next((name for name in ("avx512f", "avx2", "asimd") if name in flags), "no known vector instructions")
    if missing or not wanted:
        return Check("cpu features", "note", best, "the kernels run, several times slower than in docs/benchmarks.md")
    return Check("cpu features", "ok", best)


def memory() -> Check:
    """Memory of the machine."""
    total_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    found = f"{total_gb:.1f} GB"
    if total_gb < LEAST_MEMORY_GB:
        return Check("memory", "note", found, f"{LEAST_MEMORY_GB:.0f} GB leave room for recordings in memory")
    return Check("memory", "ok", found)


def python() -> Check:
    """The interpreter."""
    found = f"{platform.python_version()} ({sys.executable}), rfconstruct {version()}"
    if sys.version_info < OLDEST_PYTHON:
        return Check("python", "fails", found, f"install Python {OLDEST_PYTHON[0]}.{OLDEST_PYTHON[1]} or newer")
    return Check("python", "ok", found)


def packages() -> Check:
    """What the runtime cannot do without."""
    found, missing = _versions(PACKAGES)
    if missing:
        return Check("packages", "fails", f"not installed: {', '.join(missing)}", f"pip install {' '.join(missing)}")
    return Check("packages", "ok", found)


def optional_packages() -> Check:
    """What single commands need."""
    found, missing = _versions(OPTIONAL)
    if missing:
        extras = ",".join(OPTIONAL[name] for name in missing)
        without = f"{found}{'; ' * bool(found)}not installed: {', '.join(missing)}"
        return Check("optional packages", "note", without, f"if a command asks: pip install 'rfconstruct[{extras}]'")
    return Check("optional packages", "ok", found)


def _versions(names: tuple[str, ...] | dict[str, str]) -> tuple[str, list[str]]:
    """Names with versions of those installed, and the names of the others."""
    found, missing = [], []
    for name in names:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    return ", ".join(found), missing


def rigs() -> Check:
    """Every shipped rig loads and keeps the hardware's rules."""
    broken = [
        f"{name}: {rule.name}"
        for name in known_rigs()
        for rule in load_rig(name).constraints()
        if not rule.passed and rule.severity == "error"
    ]
    if broken:
        return Check("rigs", "fails", "; ".join(broken), "rfconstruct info RIG shows formula and limit of each rule")
    return Check("rigs", "ok", ", ".join(known_rigs()))


def model() -> Check:
    """The shipped network: files against their hashes, session, known answer on this processor."""
    from edge.completion.manifest import find_model
    from edge.completion.model import CompletionModel

    settings = CompletionSettings()
    loaded = CompletionModel.load(find_model(settings.model), settings)
    if loaded.fallback:
        return Check("model", "note", f"{loaded.manifest.name}: {loaded.file} runs, slower; {loaded.fallback}")
    return Check("model", "ok", f"{loaded.manifest.name}, {loaded.file}: gives its known answer")


def cache() -> Check:
    """Folder of compiled kernels."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        folder = numba_cache.enable()
    if caught or numba_cache.is_temporary(folder):
        why = f"{caught[0].message}" if caught else f"only the temporary folder {folder} can be written to"
        action = f"set {numba_cache.VARIABLE} to a private folder that can be written to, then run this with --warm"
        return Check("kernel cache", "fails", why.partition("; ")[0], action)
    try:
        numba_cache.check_private(folder)
    except OSError as error:
        action = f"make {folder} writable for this user alone, or unset {numba_cache.VARIABLE}"
        return Check("kernel cache", "fails", str(error), action)
    count = sum(1 for _ in folder.rglob("*.nbi"))
    if count == 0:
        return Check("kernel cache", "note", f"{folder} is empty", "the next start compiles; --warm does it now")
    return Check("kernel cache", "ok", f"{folder}, {count} kernels")


def kernels() -> Check:
    """Compile everything that the shipped rigs call, or load it from the cache."""
    from edge.warm import warm_up

    start_s = time.monotonic()
    for name in known_rigs():
        warm_up(load_rig(name))
    count = sum(1 for _ in Path(os.environ[numba_cache.VARIABLE]).rglob("*.nbi"))
    ready = ", ".join(known_rigs())
    return Check("kernels", "ok", f"{count} cached, ready for {ready} after {time.monotonic() - start_s:.1f} s")


def port() -> Check:
    """The default address can be bound."""
    endpoint = StreamSettings().endpoints[0]
    host, _, number = endpoint.removeprefix("tcp://").rpartition(":")
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, int(number)))
        except OSError as error:
            action = "another pipeline may be running: stop it, or publish elsewhere with --endpoint"
            return Check("port", "fails", f"{endpoint}: {error.strerror}", action)
    return Check("port", "ok", f"{endpoint} is free")


def _keys(args: argparse.Namespace) -> Callable[[], Check]:
    """The check of the keys of ``--rig``, or of the usual folder."""

    def keys() -> Check:
        return keys_check(load_rig(args.rig, args.boards).settings.stream if args.rig else None)

    return keys


def data() -> Check:
    """Optional recordings and objects."""
    folder = data_dir()
    if folder is None:
        action = "set RFCONSTRUCT_DATA to the folder with radar/ and objects/ to run the tests on real data"
        return Check("data", "note", "no real recordings here; nothing but those tests needs them", action)
    return Check("data", "ok", str(folder))
