# SPDX-License-Identifier: Apache-2.0
"""bootstrap.py: what it refuses and in which words, what it installs and when, two at a time, interrupted."""

from __future__ import annotations

import ast
import contextlib
import fcntl
import importlib.util
import os
import re
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

HERE = f"{sys.version_info[0]}.{sys.version_info[1]}"


@pytest.fixture
def clone(repository: Path, tmp_path: Path) -> Path:
    """As much of a clone as bootstrap.py looks at."""
    root = tmp_path / "a clone"
    (root / "suspension_twin_interfaces/msg").mkdir(parents=True)
    (root / "suspension_twin_interfaces/msg/Gap.msg").write_text("float64 rms\n")
    for name in ("pyproject.toml", "setup.py", "setup.cfg", "package.xml", "bootstrap.py"):
        (root / name).write_bytes((repository / name).read_bytes())
    return root


@pytest.fixture
def bootstrap(clone: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("bootstrap", clone / "bootstrap.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Installer:
    """Stands for venv and pip: makes what they would make, and says what it was called for."""

    def __init__(self, bootstrap: ModuleType) -> None:
        self.bootstrap = bootstrap
        self.steps: list[str] = []
        self.failure: BaseException | None = None
        self.lacks_pip = False

    def run(self, command: list[str]) -> None:
        if "venv" in command:
            self.steps.append("venv")
            os.makedirs(os.path.dirname(self.bootstrap.PYTHON), exist_ok=True)
            Path(self.bootstrap.PYTHON).write_text("")
            Path(self.bootstrap.STAMP).unlink(missing_ok=True)  # what --clear does
            return
        if self.failure:
            raise self.failure
        what = [argument for argument in command if argument.startswith(".") or "interfaces" in argument]
        self.steps.append("pip " + " ".join(os.path.basename(w) for w in what))

    def is_python(self, path: str, version: tuple[int, int], modules: str = "") -> bool:
        return os.path.exists(path) and not self.lacks_pip

    def took(self) -> list[str]:
        """The steps since the last time this was asked."""
        steps, self.steps = self.steps, []
        return steps


@pytest.fixture
def installer(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Installer:
    stand_in = Installer(bootstrap)
    monkeypatch.setattr(bootstrap, "run", stand_in.run)
    monkeypatch.setattr(bootstrap, "is_python", stand_in.is_python)
    return stand_in


NEW = ["venv", "pip suspension_twin_interfaces ."]
INTERFACES = ["pip suspension_twin_interfaces ."]


def test_installs_once(bootstrap: ModuleType, installer: Installer) -> None:
    bootstrap.set_up([])
    assert installer.took() == NEW
    bootstrap.set_up([])
    assert installer.took() == []


def test_extras_come_in_when_wanted_and_stay(
    bootstrap: ModuleType, installer: Installer, clone: Path
) -> None:
    bootstrap.set_up([])
    installer.took()
    bootstrap.set_up(["test"])
    assert installer.took() == ["pip .[test]"]
    bootstrap.set_up([])
    assert installer.took() == []
    (clone / "setup.py").write_text("# other requirements\n")
    bootstrap.set_up([])
    assert installer.took() == ["pip .[test]"]


def test_locked_versions_are_installed_when_they_are_asked_for(
    bootstrap: ModuleType, installer: Installer, clone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []
    monkeypatch.setattr(bootstrap, "run", lambda command: (commands.append(command), installer.run(command)))
    (clone / "constraints.txt").write_text("numpy==2.0.0\n")
    bootstrap.set_up([])
    assert "--constraint" not in commands[-1]
    bootstrap.set_up([], True)
    assert commands[-1][commands[-1].index("--constraint") + 1] == str(clone / "constraints.txt")
    count = len(commands)
    bootstrap.set_up([], True)
    assert len(commands) == count
    (clone / "constraints.txt").write_text("numpy==2.0.1\n")
    bootstrap.set_up([], True)
    assert len(commands) == count + 1


def test_versions_are_written_for_this_python_alone(bootstrap: ModuleType, clone: Path, capsys) -> None:
    (clone / "constraints.txt").write_text(
        f'numpy==1.0 ; python_version == "3.9"\nold==1.0 ; python_version == "{HERE}"\n'
    )
    bootstrap.PYTHON = sys.executable
    assert bootstrap.lock() == 0
    lines = (clone / "constraints.txt").read_text().splitlines()
    assert 'numpy==1.0 ; python_version == "3.9"' in lines and not any("old==" in line for line in lines)
    assert any(line.startswith("scipy==") and line.endswith(f'python_version == "{HERE}"') for line in lines)
    assert not any("://" in line or "@" in line or "suspension" in line for line in lines)


def test_the_oldest_versions_are_the_lower_bounds_and_the_last_of_a_name_counts(
    bootstrap: ModuleType, clone: Path
) -> None:
    text = """["one>=1.2", "two>=3,<4", "three>=1; python_version < '3.11'", "four", "six<7", "one>=1.10"]"""
    (clone / "setup.py").write_text(text)
    assert bootstrap.main(["lock", "--oldest"]) == 0
    lines = (clone / "constraints.txt").read_text().splitlines()
    assert lines == ["one==1.10", "two==3", "three==1; python_version < '3.11'"]


def test_the_versions_that_are_kept_are_of_every_python_and_name_no_address(
    bootstrap: ModuleType, repository: Path
) -> None:
    lines = (repository / "constraints.txt").read_text().splitlines()[1:]
    for version in bootstrap.SUPPORTED:
        marker = ' ; python_version == "{}.{}"'.format(*version)
        own = [line[: -len(marker)] for line in lines if line.endswith(marker)]
        names = [line.partition("==")[0] for line in own]
        assert len(own) > 200 and len(set(names)) == len(own) and {"numpy", "numba", "rosbags"} <= set(names)
        assert all(re.fullmatch(r"[a-z0-9-]+==[\w.+!-]+", line) for line in own)
        lines = [line for line in lines if not line.endswith(marker)]
    assert not lines


@pytest.mark.parametrize(
    ("file", "steps"),
    [
        ("suspension_twin_interfaces/msg/Gap.msg", INTERFACES),
        ("suspension_twin_interfaces/msg/New.msg", INTERFACES),
        ("suspension_twin_interfaces/build/temp/Gap.c", []),
        ("suspension_twin_interfaces/x.egg-info/PKG-INFO", []),
        ("pyproject.toml", ["pip ."]),
        ("package.xml", ["pip ."]),
        ("suspension_twin/new.py", []),
    ],
)
def test_installs_again_what_has_changed(
    file: str, steps: list[str], bootstrap: ModuleType, installer: Installer, clone: Path
) -> None:
    bootstrap.set_up([])
    installer.took()
    (clone / file).parent.mkdir(parents=True, exist_ok=True)
    (clone / file).write_text("changed\n")
    bootstrap.set_up([])
    assert installer.took() == steps


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), RuntimeError()], ids=["interrupted", "failed"])
def test_an_installation_that_was_interrupted_is_done_again(
    failure: BaseException, bootstrap: ModuleType, installer: Installer
) -> None:
    installer.failure = failure
    with pytest.raises(type(failure)):
        bootstrap.set_up(["test"])
    assert installer.took() == ["venv"]
    installer.failure = None
    bootstrap.set_up(["test"])
    assert installer.took() == ["venv", "pip suspension_twin_interfaces .[test]"]
    bootstrap.set_up(["test"])
    assert installer.took() == []


def test_an_environment_of_the_users_own_is_used_and_not_cleared(
    bootstrap: ModuleType, installer: Installer
) -> None:
    os.makedirs(os.path.dirname(bootstrap.PYTHON))
    Path(bootstrap.PYTHON).write_text("")
    bootstrap.set_up([])
    assert installer.took() == INTERFACES


def test_an_environment_without_pip_is_made_again(bootstrap: ModuleType, installer: Installer) -> None:
    """As a venv that was interrupted while it was made."""
    os.makedirs(os.path.dirname(bootstrap.PYTHON))
    Path(bootstrap.PYTHON).write_text("")
    installer.lacks_pip = True
    bootstrap.set_up([])
    assert installer.took() == NEW


@pytest.mark.parametrize("change", ["moved", "other Python", "Python gone", "stamp damaged"])
def test_an_environment_that_does_not_fit_is_replaced(
    change: str, bootstrap: ModuleType, installer: Installer, monkeypatch: pytest.MonkeyPatch
) -> None:
    bootstrap.set_up([])
    installer.took()
    stamp = bootstrap.read_stamp()
    if change == "moved":
        bootstrap.write_stamp({**stamp, "root": "/elsewhere"})
    elif change == "other Python":
        bootstrap.write_stamp({**stamp, "python": "3.9"})
    elif change == "Python gone":
        os.unlink(bootstrap.PYTHON)
    else:
        Path(bootstrap.STAMP).write_text("{")
    bootstrap.set_up([])
    assert installer.took() == (INTERFACES if change == "stamp damaged" else NEW)


def test_one_at_a_time(
    bootstrap: ModuleType, installer: Installer, clone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with open(clone / ".venv.lock", "a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        waiting = threading.Thread(target=bootstrap.set_up, args=([],))
        waiting.start()
        waiting.join(0.5)
        assert waiting.is_alive()
        assert installer.took() == []
        fcntl.flock(lock, fcntl.LOCK_UN)
    waiting.join(20)
    assert installer.took() == NEW
    assert "waiting for another bootstrap.py" in capsys.readouterr().err


def test_two_processes_install_once(clone: Path) -> None:
    """Real processes on a real lock; pip alone is replaced, by a list of who came."""
    (clone / "both.py").write_text(
        "import os, sys, time, bootstrap\n"
        "def run(command):\n"
        "    with open('came', 'a') as came: came.write('venv\\n' if 'venv' in command else 'pip\\n')\n"
        "    os.makedirs(os.path.dirname(bootstrap.PYTHON), exist_ok=True); open(bootstrap.PYTHON, 'a').close()\n"
        "    time.sleep(0.5)\n"
        "bootstrap.run = run\n"
        "bootstrap.check_tools = lambda: None\n"
        "bootstrap.set_up([])\n"
    )
    both = [
        subprocess.Popen([sys.executable, "both.py"], cwd=clone, stderr=subprocess.DEVNULL) for _ in range(2)
    ]
    assert [child.wait(timeout=60) for child in both] == [0, 0]
    assert (clone / "came").read_text() == "venv\npip\n"


def test_the_lock_is_held_as_long_as_a_step_runs_on(clone: Path) -> None:
    """bootstrap.py is killed in the middle of pip: the next one waits until that pip is gone."""
    (clone / "killed.py").write_text(
        "import os, sys, bootstrap\n"
        "os.makedirs(bootstrap.VENV)\n"
        "with bootstrap.locked():\n"
        "    print('locked', flush=True)\n"
        "    bootstrap.run([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
    )
    child = subprocess.Popen(
        [sys.executable, "killed.py"],
        cwd=clone,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == b"locked\n"
        time.sleep(1.0)  # until the step runs
        child.kill()
        child.wait(timeout=20)
        with open(clone / ".venv.lock", "a") as lock:
            with pytest.raises(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.killpg(child.pid, signal.SIGKILL)
            fcntl.flock(lock, fcntl.LOCK_EX)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


def test_termination_ends_the_step_too(clone: Path) -> None:
    (clone / "ended.py").write_text(
        "import os, sys, bootstrap\n"
        "os.makedirs(bootstrap.VENV)\n"
        "step = 'import time; print(1, flush=True); time.sleep(60)'\n"
        "bootstrap.set_up = lambda extras, locked: bootstrap.run([sys.executable, '-c', step])\n"
        "sys.exit(bootstrap.main(['demo']))\n"
    )
    start = time.monotonic()
    child = subprocess.Popen(
        [sys.executable, "ended.py"], cwd=clone, stderr=subprocess.PIPE, start_new_session=True
    )
    time.sleep(1.5)
    child.terminate()
    _, err = child.communicate(timeout=30)
    assert (child.returncode, err) == (130, b"\nbootstrap: interrupted, the same command takes it up again\n")
    assert time.monotonic() - start < 20
    with pytest.raises(ProcessLookupError):
        os.killpg(child.pid, 0)


def refusal(bootstrap: ModuleType, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on standard error with which a command line is refused."""
    assert bootstrap.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("bootstrap: ")
    assert err.count("\n") == 1
    assert isinstance(err, str)
    return err


@pytest.mark.parametrize(
    ("lack", "said"),
    [
        ("g++", "g++ is missing: apt-get install g++"),
        ("venv", f"the module venv is missing: apt-get install python{HERE}-venv"),
        ("Python.h", f"Python.h is missing: apt-get install python{HERE}-dev"),
        (
            "all",
            f"g++, the module venv, Python.h are missing: apt-get install g++ python{HERE}-venv python{HERE}-dev",
        ),
        ("CXX", "no-such-compiler is missing: apt-get install g++"),
    ],
)
def test_a_missing_tool_is_named_with_its_package(
    lack: str,
    said: str,
    bootstrap: ModuleType,
    installer: Installer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    compiler, headers = tmp_path / "bin/g++", tmp_path / "include/Python.h"
    for file in (compiler, headers):
        file.parent.mkdir()
        file.touch(0o755)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(compiler.parent))
    monkeypatch.setattr(sysconfig, "get_paths", lambda: {"include": str(headers.parent)})
    monkeypatch.setitem(
        sys.modules, "ensurepip", None if lack in ("venv", "all") else ModuleType("ensurepip")
    )
    if lack in ("g++", "all"):
        compiler.unlink()
    if lack in ("Python.h", "all"):
        headers.unlink()
    if lack == "CXX":
        monkeypatch.setenv("CXX", "no-such-compiler -std=c++17")
    assert refusal(bootstrap, ["demo"], capsys) == f"bootstrap: {said}\n"
    assert installer.took() == []


@pytest.mark.parametrize(
    ("system", "machine", "libc", "said"),
    [
        ("Linux", "aarch64", "glibc 2.36", "this is Linux aarch64: use an apt ROS 2 Jazzy"),
        ("Darwin", "arm64", None, "this is Darwin arm64: use an apt ROS 2 Jazzy"),
        ("Windows", "AMD64", None, "this is Windows AMD64: use an apt ROS 2 Jazzy"),
        ("Linux", "x86_64", "glibc 2.27", "need glibc 2.28 or later, this is glibc 2.27"),
        ("Linux", "x86_64", None, "need glibc 2.28 or later, this is another libc"),
    ],
)
def test_another_machine_is_refused(
    system: str,
    machine: str,
    libc: str | None,
    said: str,
    bootstrap: ModuleType,
    installer: Installer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def confstr(name: str) -> str:
        if libc is None:
            raise ValueError(name)  # musl
        return libc

    monkeypatch.setattr("platform.system", lambda: system)
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("os.confstr", confstr)
    assert said in refusal(bootstrap, ["demo"], capsys)
    assert installer.took() == []


def test_another_python_goes_on_in_one_that_is_supported(
    bootstrap: ModuleType, clone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among a version manager's dead shim, a file that is no program and a Python of another version."""
    (tmp_path / "bin").mkdir()
    for name, text in (
        ("python3.13", "#!/bin/sh\necho not installed >&2\nexit 127\n"),
        ("python3.12", "no program"),
        ("python3.11", "#!/bin/sh\nexit 1\n"),
        ("python3.10", "#!/bin/sh\nexit 2\n"),
    ):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    real = tmp_path / "bin" / f"python{HERE}"
    real.unlink()
    real.symlink_to(sys.executable)
    monkeypatch.setenv("PATH", f"{tmp_path / 'nowhere'}:{tmp_path / 'bin'}")
    monkeypatch.setattr(sys, "version_info", (3, 9, 18, "final", 0))
    gone: list[Any] = []
    monkeypatch.setattr("os.execv", lambda path, arguments: gone.append((path, arguments)))
    with pytest.raises(bootstrap.Refusal):  # execv does not return
        bootstrap.use_supported_python(["demo", "--out", "x"])
    assert gone == [(str(real), [str(real), str(clone / "bootstrap.py"), "demo", "--out", "x"])]


def test_another_python_without_one_that_is_supported_is_refused(
    bootstrap: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "version_info", (3, 9, 18, "final", 0))
    assert "needs Python 3.10 to 3.13, this is 3.9 and no other" in refusal(bootstrap, ["demo"], capsys)


def test_old_pythons_can_read_it(repository: Path) -> None:
    tree = ast.parse((repository / "bootstrap.py").read_text(), feature_version=(3, 7))
    too_new = (ast.JoinedStr, ast.NamedExpr, ast.AnnAssign, ast.AsyncFunctionDef)
    assert [node.lineno for node in ast.walk(tree) if isinstance(node, too_new)] == []
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    assert [f.name for f in functions if f.returns or f.args.kwonlyargs] == []
    froms = [node.module for node in tree.body if isinstance(node, ast.ImportFrom)]
    assert froms == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "Retrying ... 'NewConnectionError(...): Temporary failure in name resolution'",
            "no package index within",
        ),
        ("pip._vendor.urllib3.exceptions.ReadTimeoutError: Read timed out.", "no package index within reach"),
        (
            "SSLCertVerificationError(1, '[SSL: CERTIFICATE_VERIFY_FAILED]'))",
            "apt-get install ca-certificates",
        ),
        (
            "ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device",
            "no space left",
        ),
        (
            "ERROR: No matching distribution found for x",
            "cannot install: ERROR: No matching distribution found for x",
        ),
        ("something else", "cannot install: something else"),
    ],
)
def test_a_failed_step_is_one_line(
    text: str,
    said: str,
    bootstrap: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def set_up(extras: list[str], locked: bool) -> None:
        os.makedirs(bootstrap.VENV)
        bootstrap.run([sys.executable, "-c", f"import sys; print('first'); print({text!r}); sys.exit(1)"])

    monkeypatch.setattr(bootstrap, "set_up", set_up)
    assert said in refusal(bootstrap, ["demo"], capsys)
    assert text in Path(bootstrap.LOG).read_text()


def test_an_interrupt_is_one_line(
    bootstrap: ModuleType, installer: Installer, capsys: pytest.CaptureFixture[str]
) -> None:
    installer.failure = KeyboardInterrupt()
    assert bootstrap.main(["demo"]) == 130
    assert capsys.readouterr().err.endswith("\nbootstrap: interrupted, the same command takes it up again\n")


def test_a_clone_that_cannot_be_written_to_is_named(
    bootstrap: ModuleType, clone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (clone / ".venv.lock").mkdir()
    assert str(clone) in refusal(bootstrap, ["demo"], capsys)


_OPTIONS = ["-n", "2", "--dist", "loadfile", "--no-loadscope-reorder", "--max-worker-restart", "2"]
_PYTEST = ["pytest", *_OPTIONS]


@pytest.mark.parametrize(
    ("arguments", "extras", "command"),
    [
        (["demo", "--out", "x"], [], ["suspension_twin", "demo", "--out", "x"]),
        (["run", "--twin", "t"], [], ["suspension_twin", "run", "--twin", "t"]),
        (["--version"], [], ["suspension_twin", "--version"]),
        (["test"], ["test"], _PYTEST),
        (["test", "-k", "x"], ["test"], [*_PYTEST, "-k", "x"]),
    ],
    ids=lambda value: " ".join(value),
)
def test_what_is_run_in_the_end(
    arguments: list[str],
    extras: list[str],
    command: list[str],
    bootstrap: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    wanted: list[list[str]] = []
    gone: list[Any] = []
    monkeypatch.setattr(bootstrap, "set_up", lambda extras, locked: wanted.append(extras))
    monkeypatch.setattr("os.execve", lambda path, line, env: gone.append((path, line, Path.cwd())))
    bootstrap.main(arguments)
    assert wanted == [extras]
    place = Path(bootstrap.ROOT) if arguments[0] == "test" else tmp_path  # results land where the user stands
    assert gone == [(bootstrap.PYTHON, [bootstrap.PYTHON, "-m", *command], place)]


def test_help(bootstrap: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert bootstrap.main(["--help"]) == 0
    shown = capsys.readouterr()
    assert bootstrap.main([]) == 2
    assert capsys.readouterr().err == shown.out
    for command in ("demo", "test", "check"):
        assert f"python3 bootstrap.py {command}" in shown.out


def clean(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch, **variables: str) -> dict[str, str]:
    for name in (*bootstrap.FOREIGN, "LD_LIBRARY_PATH"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    env = bootstrap.clean_environment()
    assert isinstance(env, dict)
    return env


@pytest.mark.parametrize(
    "sourced",
    [
        {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"},
        {"AMENT_PREFIX_PATH": "/opt/ros/humble", "ROS_DISTRO": "humble"},
    ],
    ids=["other wheels", "apt"],
)
def test_another_ros_does_not_leak_in(
    sourced: dict[str, str], bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = {"PYTHONPATH": "/opt/ros/lib", "LD_LIBRARY_PATH": "/opt/ros/lib"}
    foreign = {**sourced, **paths, "RMW_IMPLEMENTATION": "rmw_x"}
    env = clean(bootstrap, monkeypatch, **foreign)
    assert set(foreign) & set(env) == set()


def test_the_rest_of_the_environment_stays(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = {
        "LD_LIBRARY_PATH": "/opt/cuda",
        "ROS_DOMAIN_ID": "7",
        "PIP_INDEX_URL": "file:///mirror",
        "CXX": "clang++",
    }
    env = clean(bootstrap, monkeypatch, VIRTUAL_ENV="/other", PIP_USER="1", **kept)
    assert {name: env.get(name) for name in kept} == kept
    assert env["VIRTUAL_ENV"] == bootstrap.VENV
    assert "PIP_USER" not in env
    assert env["PATH"].split(os.pathsep)[0] == os.path.join(bootstrap.VENV, "bin")


def test_ros_can_log_without_a_home(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HOME")
    monkeypatch.delenv("ROS_HOME", raising=False)
    home = clean(bootstrap, monkeypatch)["HOME"]
    assert os.path.isdir(home)
    env = clean(bootstrap, monkeypatch, HOME="/nowhere")
    assert env["ROS_HOME"].startswith(bootstrap.VENV)
    env = clean(bootstrap, monkeypatch, HOME="/nowhere", ROS_HOME="/logs")
    assert env["ROS_HOME"] == "/logs"


def test_steps_run_without_the_foreign_environment(
    bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch, clone: Path
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    os.makedirs(bootstrap.VENV)
    code = "import os; print(os.environ.get('PYTHONPATH'), os.getcwd())"
    bootstrap.run([sys.executable, "-I", "-c", code])
    assert Path(bootstrap.LOG).read_text().splitlines()[-1] == f"None {clone}"


CHECKS: tuple[Callable[[ModuleType], None], ...] = (
    lambda bootstrap: bootstrap.check_machine(),
    lambda bootstrap: bootstrap.check_tools(),
)


@pytest.mark.parametrize("check", CHECKS, ids=["machine", "tools"])
def test_this_machine_is_right(check: Callable[[ModuleType], None], bootstrap: ModuleType) -> None:
    """It installed what runs this test."""
    check(bootstrap)
