# SPDX-License-Identifier: Apache-2.0
"""The kernel's own BMI160 driver in QEMU, read by the source ``iio:bmi160``.

Debian's kernel runs with ``i2c-stub``, a bus that has registers and nothing else, and ``bmi160_i2c`` on it. The
registers hold what a BMI160 at rest has there. The driver makes its sysfs tree of them; the tree is printed on the
serial line, laid out here again and read by the source, which has to find the acceleration and the rates that the
data sheet (BST-BMI160-DS000) gives for these registers. The stub has no interrupt, so the buffer is not used.

    apt-get install qemu-system-x86 busybox-static cpio kmod
    apt-get download linux-image-6.1.0-50-amd64      # or another Debian kernel
    python benchmarks/iio_qemu.py linux-image-*.deb

``--write FILE`` keeps the tree: the tests read the one in ``test/addons/sources/data``.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from extras import unavailable
from options import parse_options

#: Raw values of the six axes and the registers of their low bytes, little-endian.
RATE, FORCE = (100, -200, 300), (160, -320, 16384)
DATA = dict(zip((0x0C, 0x0E, 0x10, 0x12, 0x14, 0x16), RATE + FORCE, strict=True))
#: The chip's id, 100 Hz and ±2 g of the accelerometer, 100 Hz and ±2000 °/s of the gyroscope.
SETTINGS = {0x00: 0xD1, 0x40: 0x28, 0x41: 0x03, 0x42: 0x28, 0x43: 0x00}
#: What one step of the raw values is, in m/s² and rad/s, by the data sheet.
FORCE_STEP, RATE_STEP = 9.80665 / 16384.0, np.radians(1.0 / 16.4)
#: The driver rounds its scales to 1e-6, which is 0.1 % of either step.
TOLERANCE = 0.002
MODULES = ("i2c-stub", "i2c-dev", "bmi160_i2c")
PROGRAMS = ("qemu-system-x86_64", "busybox", "cpio", "depmod", "modprobe", "dpkg-deb")
MARK = "@@@"

INIT = """#!/bin/busybox sh
export PATH=/bin
/bin/busybox --install -s /bin
mkdir -p /proc /sys /dev
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
{loads}
for d in /sys/class/i2c-adapter/i2c-*; do grep -q "SMBus stub" $d/name && bus=${{d##*-}}; done
{sets}
echo bmi160 0x69 > /sys/class/i2c-adapter/i2c-$bus/new_device
sleep 1
cd /sys/bus/iio/devices/iio:device0/ || {{ dmesg | tail -20; poweroff -f; }}
find . -type f | sort | while read f; do
  case $f in ./power/*|./uevent|./dev) continue;; esac
  value=$(cat $f 2>/dev/null) && echo "{mark} ${{f#./}} $value"
done
echo "{mark} end"
poweroff -f
"""


def initramfs(root: Path, modules: Path, version: str) -> Path:
    """An archive of busybox, the modules, and a program that sets the registers and prints the tree."""
    (root / "bin").mkdir(parents=True)
    shutil.copy(str(shutil.which("busybox")), root / "bin" / "busybox")
    loads: list[str] = []
    for module in MODULES:
        asked = ["modprobe", "-d", str(modules), "-S", version, "--show-depends", module]
        for line in subprocess.run(asked, check=True, capture_output=True, text=True).stdout.splitlines():
            kind, path = line.split()[:2]
            if kind != "insmod" or (root / Path(path).name).exists():
                continue
            shutil.copy(path, root / Path(path).name)
            loads.append(f"insmod /{Path(path).name}{' chip_addr=0x69' if module == 'i2c-stub' else ''}")
    registers = dict(SETTINGS)
    for address, value in DATA.items():
        registers[address], registers[address + 1] = (value & 0xFFFF).to_bytes(2, "little")
    sets = [f"i2cset -y $bus 0x69 {a:#04x} {v:#04x} b" for a, v in registers.items()]
    (root / "init").write_text(INIT.format(loads="\n".join(loads), sets="\n".join(sets), mark=MARK))
    (root / "init").chmod(0o755)
    names = "\n".join(str(path.relative_to(root)) for path in sorted(root.rglob("*")))
    archive = root.with_suffix(".cpio")
    with archive.open("wb") as out:
        packed = ["cpio", "-o", "-H", "newc", "--quiet"]
        subprocess.run(packed, input=names.encode(), stdout=out, cwd=root, check=True)
    return archive


def boot(package: Path, folder: Path) -> tuple[str, dict[str, str]]:
    """The version of the kernel, and name and content of the files that the driver makes."""
    subprocess.run(["dpkg-deb", "-x", str(package), str(folder / "deb")], check=True)
    kernels = list((folder / "deb" / "boot").glob("vmlinuz-*"))
    if len(kernels) != 1:
        raise SystemExit(f"{package}: holds no kernel")
    version = kernels[0].name.removeprefix("vmlinuz-")
    subprocess.run(["depmod", "-b", str(folder / "deb"), version], check=True)
    archive = initramfs(folder / "root", folder / "deb", version)
    command = ["qemu-system-x86_64", "-m", "512", "-nographic", "-no-reboot", "-kernel", str(kernels[0])]
    command += ["-initrd", str(archive), "-append", "console=ttyS0 quiet panic=-1"]
    done = subprocess.run(command, capture_output=True, timeout=120, stdin=subprocess.DEVNULL, check=False)
    lines = done.stdout.decode(errors="replace").replace("\r", "").splitlines()
    if f"{MARK} end" not in lines:
        raise SystemExit("the driver made no device:\n" + "\n".join([*lines[-30:], done.stderr.decode()]))
    found = (re.match(rf"{MARK} (\S+) ?(.*)", line) for line in lines)
    return version, {m[1]: m[2] for m in found if m and m[1] != "end"}


def read(tree: dict[str, str], folder: Path) -> Any:
    """The samples that the source reads from the tree."""
    from suspension_twin.addons.sources import iio, make_sources
    from suspension_twin.addons.sources.common.hub import Hub
    from suspension_twin.addons.sources.common.runner import running

    for name, value in tree.items():
        path = folder / "sys" / "iio:device0" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(value + "\n")
    iio.SYSFS = folder / "sys"
    hub = Hub()

    async def work() -> Any:
        sources = make_sources(["iio:bmi160?rate=100"], hub)
        async with running(sources, hub):
            for _ in range(100):
                await asyncio.sleep(0.1)
                packets = hub.take()
                if packets:
                    return packets[0].samples
        raise SystemExit("the source reads nothing from the tree")

    return asyncio.run(work())


def main() -> int:
    """Boot, read, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("package", type=Path, help="the package of a Debian kernel, linux-image-*.deb")
    parser.add_argument("--write", type=Path, help="keep the tree in this file")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    arguments = parse_options(parser)
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        unavailable(f"not installed: {', '.join(missing)}")
    if not arguments.package.is_file():
        unavailable(f"{arguments.package}: no such file")
    with tempfile.TemporaryDirectory() as name:
        version, tree = boot(arguments.package, Path(name))
        samples = read(tree, Path(name))
    wanted = np.concatenate([np.multiply(FORCE, FORCE_STEP), np.multiply(RATE, RATE_STEP)])
    found = np.concatenate([samples.specific_force[0], samples.angular_rate[0]])
    worst = float(np.max(np.abs(found / wanted - 1.0)))
    if arguments.write:
        head = (
            "# SPDX-License-Identifier: Apache-2.0\n"
            f"# The device's sysfs folder of Linux {version}, i2c-stub and bmi160_i2c: file and content.\n"
        )
        arguments.write.write_text(head + "".join(f"{file} {text}\n" for file, text in tree.items()))
    if arguments.json:
        figures = {"kernel": version, "files": len(tree), "worst_relative_error": worst}
        print(json.dumps(figures | {"found": found.tolist(), "data_sheet": wanted.tolist()}))
    else:
        print(f"Linux {version}: the driver makes {len(tree)} files")
        print(f"{'axis':<26}{'source':>12}{'data sheet':>12}")
        axes = [
            f"{kind} {axis}" for kind in ("specific force, m/s²,", "angular rate, rad/s,") for axis in "xyz"
        ]
        for axis, a, b in zip(axes, found, wanted, strict=True):
            print(f"{axis:<26}{a:>12.5f}{b:>12.5f}")
        print(f"Largest relative difference {worst:.2%}, tolerance {TOLERANCE:.1%}")
    return 0 if worst < TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
