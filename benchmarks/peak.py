# SPDX-License-Identifier: Apache-2.0
"""The machine's arithmetic peak in float64: fused multiply-adds that wait for nothing, in registers.

Written in LLVM's own language, so that no compiler's choice stands between the question and the
machine: twelve to sixteen independent sums of the widest vectors, each ``x = x a + b``. A multiply and
an add count as two operations.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import time
from concurrent.futures import ThreadPoolExecutor

import llvmlite.binding as llvm
from options import parse_options

_SUMS = 16
_ROUNDS = 3_000_000


def _source(width: int) -> str:
    v = f"<{width} x double>"
    fma = f"@llvm.fma.v{width}f64"
    lines = [
        f"declare {v} {fma}({v}, {v}, {v})",
        "define double @peak(i64 %n, double %a, double %b) {",
        "entry:",
    ]
    for name in "ab":
        lines += [
            f"%{name}0 = insertelement {v} undef, double %{name}, i32 0",
            f"%{name}v = shufflevector {v} %{name}0, {v} undef, <{width} x i32> zeroinitializer",
        ]
    lines += ["br label %loop", "loop:", "%i = phi i64 [0, %entry], [%next, %loop]"]
    lines += [f"%x{k} = phi {v} [%bv, %entry], [%y{k}, %loop]" for k in range(_SUMS)]
    lines += [f"%y{k} = call {v} {fma}({v} %x{k}, {v} %av, {v} %bv)" for k in range(_SUMS)]
    lines += [
        "%next = add i64 %i, 1",
        "%end = icmp eq i64 %next, %n",
        "br i1 %end, label %out, label %loop",
        "out:",
    ]
    total = "%y0"
    for k in range(1, _SUMS):
        lines.append(f"%s{k} = fadd {v} {total}, %y{k}")
        total = f"%s{k}"
    return "\n".join([*lines, f"%r = extractelement {v} {total}, i32 0", "ret double %r", "}"])


def arithmetic_peak(threads: int = 1, repeats: int = 5) -> float:
    """float64 operations per second of ``threads`` cores together, the best of a few tries."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return max(_measured(width, threads, repeats) for width in (4, 8))


def _measured(width: int, threads: int, repeats: int) -> float:
    module = llvm.parse_assembly(_source(width))
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3
    )
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    kind = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_int64, ctypes.c_double, ctypes.c_double)
    loop = kind(engine.get_function_address("peak"))
    operations = 2.0 * width * _SUMS * _ROUNDS

    def run(_: int) -> float:
        start = time.thread_time()
        loop(_ROUNDS, 0.5, 0.25)
        return operations / (time.thread_time() - start)

    best = 0.0
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(repeats):
            best = max(best, sum(pool.map(run, range(threads))))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--repeats", type=int, default=5, help="tries, of which the best counts")
    options = parse_options(parser, repeats=1)
    found = arithmetic_peak(repeats=options.repeats)
    if options.json:
        print(json.dumps({"operations_per_second": found}))
    else:
        print(f"{found / 1e9:.1f} GFLOP/s on one core")


if __name__ == "__main__":
    main()
