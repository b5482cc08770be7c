#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Set this clone up and run something in it, by one command on a fresh machine.

    python3 bootstrap.py demo [...]     the main job: suspension-twin demo
    python3 bootstrap.py test [...]     the tests; what follows goes to pytest
    python3 bootstrap.py check          ruff and mypy alone
    python3 bootstrap.py check --size   counts of the code and their limits; --list names what is counted
    python3 bootstrap.py check --licences, --sbom   what is installed: licences, bill of materials
    python3 bootstrap.py check --results   kept results that are older than the code that they measure
    python3 bootstrap.py COMMAND ...    any other command of suspension-twin
    python3 bootstrap.py --locked ...   the same, with the versions of constraints.txt alone
    python3 bootstrap.py lock           write the versions in .venv to constraints.txt, for this Python
    python3 bootstrap.py lock --oldest  write the oldest versions that setup.py allows to constraints.txt

The first run makes a virtual environment in .venv and installs everything into it, later runs
start at once. Needs Python 3.10 to 3.13, git and g++ on x86-64 Linux.
"""
# Standard library alone, and no syntax that the Pythons to be refused cannot read (hence % and no annotations).

import contextlib
import hashlib
import json
import os
import platform
import re
import signal
import subprocess
import sys
import sysconfig

ROOT = os.path.dirname(os.path.abspath(__file__))
VENV = os.path.join(ROOT, ".venv")
PYTHON = os.path.join(VENV, "bin", "python")
STAMP = os.path.join(VENV, "bootstrap.json")
LOG = os.path.join(VENV, "bootstrap.log")
CONSTRAINTS = os.path.join(ROOT, "constraints.txt")
SUPPORTED = ((3, 10), (3, 11), (3, 12), (3, 13))

# What an installation depends on, so that it is done again when that has changed.
INTERFACES = ["suspension_twin_interfaces"]
PACKAGE = ["pyproject.toml", "setup.py", "setup.cfg", "package.xml"]

# Variables of another Python, another environment or another ROS that would leak into ours.
FOREIGN = """PYTHONPATH PYTHONHOME PYTHONUSERBASE VIRTUAL_ENV VIRTUAL_ENV_PROMPT __PYVENV_LAUNCHER__
PIP_USER PIP_TARGET PIP_PREFIX PIP_ROOT AMENT_PREFIX_PATH COLCON_PREFIX_PATH ROS_DISTRO ROS_VERSION
ROS_PYTHON_VERSION RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE""".split()

NETWORK = re.compile(
    r"NewConnectionError|NameResolution|name resolution|timed out|Max retries|unreachable|ProxyError"
)
TROUBLES = (  # in pip's words, and in ours
    (NETWORK, "no package index within reach: connect to the network, or set PIP_INDEX_URL to a mirror"),
    (
        re.compile(r"SSLError|CERTIFICATE_VERIFY"),
        "cannot verify the package index: apt-get install ca-certificates",
    ),
    (re.compile(r"No space left|Errno 28"), "no space left on the disk: about 2 GB are needed"),
)


class Refusal(Exception):
    """One line for the user, and exit status 2."""


def main(arguments):
    if not arguments or arguments[0] in ("-h", "--help"):
        (sys.stdout if arguments else sys.stderr).write(__doc__)
        return 0 if arguments else 2
    if arguments == ["lock", "--oldest"]:
        return lock_oldest()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that pip ends with this
    locked_versions = arguments[0] == "--locked"
    try:
        use_supported_python(arguments)
        arguments = arguments[locked_versions:] or ["--help"]
        command = arguments[0]
        extras = ["test"] if command in ("test", "check") else []
        set_up(extras + (["foxglove"] if "--foxglove" in arguments else []), locked_versions)
        if command == "lock":
            return lock()
    except Refusal as refusal:
        sys.stderr.write("bootstrap: %s\n" % refusal)
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("\nbootstrap: interrupted, the same command takes it up again\n")
        return 130
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    env = clean_environment()
    sys.stdout.flush()
    programs = {"--size": "size.py", "--licences": "sbom.py", "--sbom": "sbom.py", "--results": "results.py"}
    for asked in [option for option in arguments if command == "check" and option in programs]:
        program = os.path.join(ROOT, "test", "house", programs[asked])
        return subprocess.call([PYTHON, program] + arguments[1:], cwd=ROOT, env=env)
    if command == "check":
        tools = [["ruff", "check", "."], ["mypy"]]
        return max([subprocess.call([PYTHON, "-m"] + tool, cwd=ROOT, env=env) for tool in tools])
    if command == "test":
        os.chdir(ROOT)
        # In the files' order: by their number of tests the few that take minutes would come last, one after the other.
        # A test that hangs is ended and tried by another worker, twice at most.
        options = ["-n", "2", "--dist", "loadfile", "--no-loadscope-reorder", "--max-worker-restart", "2"]
        arguments = ["pytest"] + options + arguments[1:]
    else:
        arguments = ["suspension_twin"] + arguments
    os.execve(PYTHON, [PYTHON, "-m"] + arguments, env)


def use_supported_python(arguments):
    """Go on in a Python that is supported, if this one is not."""
    if sys.version_info[:2] in SUPPORTED:
        return
    folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
    for version in reversed(SUPPORTED):
        for path in [os.path.join(folder, "python%d.%d" % version) for folder in folders]:
            # A file of that name may be a version manager's shim that leads nowhere: ask it.
            if os.access(path, os.X_OK) and is_python(path, version):
                sys.stdout.flush()
                os.execv(path, [path, os.path.abspath(__file__)] + arguments)
    raise Refusal(
        "needs Python 3.10 to 3.13, this is %d.%d and no other is on the PATH: "
        "apt-get install python3.11 (Debian 12) or python3.12 (Ubuntu 24.04)" % sys.version_info[:2]
    )


def is_python(path, version, modules=""):
    """Whether ``path`` runs as that version of Python and has the modules."""
    code = "import sys%s; sys.exit(sys.version_info[:2] != %r)" % (modules, version)
    with open(os.devnull, "w") as nowhere:
        try:
            return subprocess.call([path, "-I", "-c", code], stdout=nowhere, stderr=nowhere) == 0
        except OSError:
            return False


def set_up(extras, locked_versions=False):
    """Bring .venv up to date. Quick when it is, one at a time, and begun again where it was interrupted."""
    wanted = {
        "root": ROOT,
        "python": "%d.%d" % sys.version_info[:2],
        "interfaces": digest(INTERFACES),
        "package": digest(PACKAGE),
    }
    if locked_versions:
        wanted["constraints"] = digest([os.path.basename(CONSTRAINTS)])
    with locked():
        have = read_stamp()
        same = {key: have.get(key) == wanted[key] for key in wanted}
        extras = sorted(set(extras) | set(have.get("extras", [])))
        if all(same.values()) and extras == have.get("extras") and os.path.exists(PYTHON):
            return
        check_machine()
        check_tools()
        whole = not have or (same["root"] and same["python"])
        if not (whole and is_python(PYTHON, sys.version_info[:2], ", pip")):
            say("making .venv with Python %s" % wanted["python"])
            base = getattr(sys, "_base_executable", None) or sys.executable
            run([base, "-I", "-m", "venv", "--clear", VENV])
            have = same = {}
        write_stamp({"python": "interrupted"})
        say("installing into .venv, some minutes the first time")
        targets = [] if same.get("interfaces") else [os.path.join(ROOT, folder) for folder in INTERFACES]
        targets += ["-e", ".[%s]" % ",".join(extras) if extras else "."]
        options = [
            "--no-input",
            "--disable-pip-version-check",
            "--no-warn-script-location",
            "--progress-bar",
            "off",
        ]
        if locked_versions:
            options += ["--constraint", CONSTRAINTS]
        run([PYTHON, "-m", "pip", "install"] + options + targets)
        wanted["extras"] = extras
        write_stamp(wanted)


#: Name and version of every installed package that ours need, directly or not; for a Python of any version.
NEEDED = """
import importlib.metadata as known, re
plain = lambda name: re.sub(r"[-_.]+", "-", name).lower()
own = ["suspension-twin", "suspension-twin-interfaces"]
found, left = {}, list(own)
while left:
    name = plain(re.match(r"[A-Za-z0-9._-]+", left.pop()).group())
    try:
        package = known.distribution(name)
    except known.PackageNotFoundError:
        continue
    if name not in found:
        found[name] = package.version
        left += package.requires or []
print("\\n".join("%s==%s" % pair for pair in sorted(found.items()) if pair[0] not in own))
"""


def lock():
    """Write the versions in .venv to constraints.txt: those for this Python, without addresses."""
    marker = '; python_version == "%d.%d"' % sys.version_info[:2]
    known = subprocess.check_output([PYTHON, "-I", "-c", NEEDED], cwd=ROOT, env=clean_environment())
    kept = []
    if os.path.exists(CONSTRAINTS):
        with open(CONSTRAINTS) as file:
            kept = [line for line in file.read().splitlines() if ";" in line and not line.endswith(marker)]
    lines = ["%s %s" % (line, marker) for line in known.decode().split()]
    with open(CONSTRAINTS + ".new", "w") as file:
        file.write("# Versions that the tests passed with, by Python: python3 bootstrap.py lock\n")
        file.write("".join("%s\n" % line for line in sorted(kept + lines)))
    os.rename(CONSTRAINTS + ".new", CONSTRAINTS)
    say("%d versions in %s" % (len(lines), os.path.relpath(CONSTRAINTS)))
    return 0


def lock_oldest():
    """Write the lower bounds of setup.py to constraints.txt: ``--locked`` then installs the oldest that it allows."""
    with open(os.path.join(ROOT, "setup.py")) as file:
        found = re.findall(r'"([\w.-]+)>=([\w.]+)[^";]*(;[^"]*)?"', file.read())
    bounds = {name: "%s==%s%s\n" % (name, version, marker) for name, version, marker in found}
    with open(CONSTRAINTS, "w") as file:
        file.write("".join(bounds.values()))
    say("%d versions in %s" % (len(bounds), os.path.relpath(CONSTRAINTS)))
    return 0


def check_machine():
    """ROS 2 comes as wheels for one kind of machine alone."""
    machine = "%s %s" % (platform.system(), platform.machine())
    if machine not in ("Linux x86_64", "Linux amd64") or sys.maxsize < 2**32:
        bits = "" if sys.maxsize > 2**32 else ", 32-bit Python"
        raise Refusal(
            "the ROS 2 wheels are for 64-bit x86 Linux alone, this is %s%s: use an apt ROS 2 Jazzy, see README.md"
            % (machine, bits)
        )
    try:
        libc = os.confstr("CS_GNU_LIBC_VERSION") or "another libc"
    except (OSError, ValueError):
        libc = "another libc"
    found = re.match(r"glibc (\d+)\.(\d+)", libc)
    if not found or (int(found.group(1)), int(found.group(2))) < (2, 28):
        raise Refusal(
            "the ROS 2 wheels need glibc 2.28 or later, this is %s: use Debian 12 or Ubuntu 24.04" % libc
        )
    if platform.python_implementation() != "CPython" or sysconfig.get_config_var("Py_GIL_DISABLED"):
        raise Refusal(
            "the ROS 2 wheels are for the standard CPython, this is another build: apt-get install python3"
        )


def check_tools():
    """What building the interfaces takes and Debian packs apart from Python, with the packages to install."""
    python = "python%d.%d" % sys.version_info[:2]
    compiler = os.environ.get("CXX", "").split()[:1] or ["g++"]
    missing = []
    folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
    if not any(os.access(os.path.join(folder, compiler[0]), os.X_OK) for folder in folders):
        missing.append((compiler[0], "g++"))
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError:
        missing.append(("the module venv", python + "-venv"))
    if not os.path.exists(os.path.join(sysconfig.get_paths()["include"], "Python.h")):
        missing.append(("Python.h", python + "-dev"))
    if missing:
        names, packages = zip(*missing)
        verb = "is" if len(names) == 1 else "are"
        raise Refusal("%s %s missing: apt-get install %s" % (", ".join(names), verb, " ".join(packages)))


def run(command):
    """Run a step of the installation, with its last line as progress and all of it in the log."""
    lines = []
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env=clean_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        close_fds=False,
    )
    try:
        for line in process.stdout:
            lines.append(line)
            if sys.stderr.isatty():
                sys.stderr.write("\r\033[K  %s" % line.strip()[:76])
    finally:
        if process.poll() is None and sys.exc_info()[0]:
            process.terminate()
        process.wait()
        if sys.stderr.isatty():
            sys.stderr.write("\r\033[K")
        if os.path.isdir(VENV):
            with open(LOG, "a", encoding="utf-8") as log:
                log.writelines(["$ %s\n" % " ".join(command)] + lines)
    if process.returncode:
        text = "".join(lines)
        for pattern, trouble in TROUBLES:
            if pattern.search(text):
                raise Refusal(trouble)
        errors = (
            [line.strip() for line in lines if "error" in line.lower()]
            or [line.strip() for line in lines]
            or [""]
        )
        raise Refusal("cannot install: %s (all of it in %s)" % (errors[-1], os.path.relpath(LOG)))


def clean_environment():
    """The environment of everything that runs in .venv."""
    env = dict(os.environ)
    if "_ROS_WHEELS_BOOTSTRAP_COMPLETE" in env or "AMENT_PREFIX_PATH" in env:
        env.pop("LD_LIBRARY_PATH", None)  # the libraries of that other ROS
    for name in FOREIGN:
        env.pop(name, None)
    home = env.setdefault("HOME", os.path.expanduser("~"))
    if not os.access(home, os.W_OK) and "ROS_LOG_DIR" not in env:
        env.setdefault("ROS_HOME", os.path.join(VENV, "ros"))  # ROS does not start where it cannot log
    env["VIRTUAL_ENV"] = VENV
    env["PATH"] = os.pathsep.join([os.path.dirname(PYTHON), env.get("PATH", os.defpath)])
    return env


@contextlib.contextmanager
def locked():
    """Hold the clone's lock: two at the same time would install over each other."""
    import fcntl

    try:
        lock = open(os.path.join(ROOT, ".venv.lock"), "a")
    except (IOError, OSError) as error:
        raise Refusal("cannot write to %s: %s" % (ROOT, error.strerror))
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (IOError, OSError):
            say("waiting for another bootstrap.py in this clone")
            fcntl.flock(lock, fcntl.LOCK_EX)
        os.set_inheritable(lock.fileno(), True)  # a pip that outlives this process holds it on
        yield


def digest(names):
    """A hash of these files, and of all sources in these folders."""
    sums = hashlib.sha256()
    for name in names:
        top = os.path.join(ROOT, name)
        paths = [top]
        if os.path.isdir(top):
            paths = [os.path.join(d, f) for d, _, files in os.walk(top) for f in files]
            paths = [p for p in paths if not re.search(r"/build/|egg-info/|__pycache__/", p)]
        for path in sorted(paths):
            with open(path, "rb") as file:
                sums.update(("%s\n" % os.path.relpath(path, ROOT)).encode())
                sums.update(file.read())
    return sums.hexdigest()


def read_stamp():
    """What the last installation left: empty if there was none, another ``python`` if it was interrupted."""
    try:
        with open(STAMP) as file:
            return json.load(file)
    except (IOError, OSError, ValueError):
        return {}


def write_stamp(content):
    with open(STAMP + ".new", "w") as file:
        json.dump(content, file)
    os.rename(STAMP + ".new", STAMP)


def say(text):
    sys.stderr.write("bootstrap: %s\n" % text)
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
