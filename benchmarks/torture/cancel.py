# SPDX-License-Identifier: Apache-2.0
"""Goals that are cancelled, doubled or abandoned, and a node that ends under a goal: answered in time, nothing left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from torture.commands import ROOT, environment
from torture.ledger import Tally

os.environ.setdefault("ROS_DOMAIN_ID", str(60 + os.getpid() % 40))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"  # shared memory leaks from killed processes

__all__ = ["BAR", "torture"]

BAR = "answered within the stated patience; nothing left running"

#: What the command ``calibrator`` runs.
_PROGRAM = (
    "from suspension_twin.nodes.calibrator import CalibratorNode; raise SystemExit(CalibratorNode.main())"
)
_PATIENCE = 3.0  # s, the node's parameter
_GRACE = 3.0  # s more for messages and a busy machine
_KINDS = ("cancel", "cancel", "cancel", "two goals", "client gone", "node ends", "node killed")


def _descendants(process: int) -> set[int]:
    """Numbers of all processes below one."""
    found: set[int] = set()
    waiting = [process]
    while waiting:
        here = waiting.pop()
        try:
            tasks = list(Path(f"/proc/{here}/task").iterdir())
            below = [int(word) for task in tasks for word in (task / "children").read_text().split()]
        except OSError:
            continue
        waiting += below
        for number in below:
            try:
                line = Path(f"/proc/{number}/cmdline").read_bytes()
            except OSError:
                continue
            if b"resource_tracker" not in line:  # Python's own, which stays with its process
                found.add(number)
    return found


def _alive(processes: set[int], seconds: float) -> set[int]:
    """Those that still run after so long, zombies not counted."""
    until = time.monotonic() + seconds
    while True:
        left = set()
        for number in processes:
            try:
                state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
            except OSError:
                continue
            if state != "Z":
                left.add(number)
        if not left or time.monotonic() > until:
            return left
        time.sleep(0.1)


class _Bench:
    """A calibrator in a process of its own, and a client."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.action.client import ActionClient
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.utilities import ok

        from suspension_twin_interfaces.action import Calibrate

        if not ok():
            rclpy.init(args=["--ros-args", "--log-level", "error"])
        self.kind = Calibrate
        self.node = rclpy.create_node("canceller")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-c", _PROGRAM, "--ros-args"),
                *("-p", f"cancel_patience:={_PATIENCE}", "-p", "threads:=1"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=environment(),
        )
        self.client = ActionClient(self.node, Calibrate, "calibrate")
        until = time.monotonic() + 300
        while not self.client.server_is_ready():
            self.executor.spin_once(timeout_sec=0.1)
            if time.monotonic() > until or self.process.poll() is not None:
                raise RuntimeError("the calibrator does not listen")

    def until(self, future: Any, seconds: float) -> Any:
        """The result of a future; None if it does not come."""
        self.executor.spin_until_future_complete(future, timeout_sec=seconds)
        return future.result() if future.done() else None

    def goal(self, out: Path) -> Any:
        """Ask for a calibration that takes half a minute; its handle, None without an answer."""
        bag = ROOT / "bags" / "bump_15kmh"
        goal = self.kind.Goal(
            twin=str(bag / "twin.yaml"),
            bags=[str(bag)],
            output=str(out),
            preset="paper",
            max_generations=5000,
        )
        return self.until(self.client.send_goal_async(goal), 10.0)

    def spin(self, seconds: float) -> None:
        """Let time pass."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.executor.spin_once(timeout_sec=min(left, 0.1))

    def close(self) -> None:
        """End everything."""
        self.process.kill()
        self.process.wait()
        self.client.destroy()
        self.executor.shutdown()
        self.node.destroy_node()


def _trial(tally: Tally, bench: _Bench, kind: str, rng: np.random.Generator, folder: Path) -> str | None:
    out = folder / "calibrated.yaml"
    resting = _descendants(bench.process.pid)
    handle = bench.goal(out)
    if handle is None or not handle.accepted:
        return f"a goal was {'not answered' if handle is None else 'rejected'} though none was running"
    result = handle.get_result_async()
    bench.spin(float(rng.uniform(0.0, 12.0)))
    if result.done():
        tally.count("was through before")
        return None
    working = _descendants(bench.process.pid) - resting
    if kind == "two goals":
        second = bench.goal(folder / "other.yaml")
        if second is None:
            return "the second goal was not answered"
        if second.accepted:
            return None if result.done() else "a second goal was accepted"
    if kind == "node killed":
        bench.process.kill()
        bench.process.wait()
        left = _alive(working, 15.0)
        return f"{len(left)} workers outlive their node" if left else None
    if kind == "node ends":
        began = time.monotonic()
        bench.process.send_signal(signal.SIGTERM)
        try:
            bench.process.wait(10.0)
        except subprocess.TimeoutExpired:
            return "the node does not end within 10 s"
        tally.measure("node ends, s", time.monotonic() - began)
        left = _alive(working, 5.0)
        return f"{len(left)} workers outlive their node" if left else None
    if kind == "client gone":
        from rclpy.action.client import ActionClient

        bench.client.destroy()
        bench.client = ActionClient(bench.node, bench.kind, "calibrate")
        bench.spin(1.0)
        if bench.process.poll() is not None:
            return "the node died of it"
        from action_msgs.srv import CancelGoal

        cancel = bench.node.create_client(CancelGoal, "calibrate/_action/cancel_goal")
        bench.until(cancel.call_async(CancelGoal.Request()), 10.0)
        bench.node.destroy_client(cancel)
    else:
        began = time.monotonic()
        bench.until(handle.cancel_goal_async(), 10.0)
        answer = bench.until(result, _PATIENCE + _GRACE)
        if answer is None:
            return f"no result {time.monotonic() - began:.1f} s after it was cancelled"
        tally.measure("result after cancel, s", time.monotonic() - began)
        if not answer.result.message:
            return "a result without a message"
        if answer.result.success != out.is_file():
            return f"success is {answer.result.success}, the file is {'' if out.is_file() else 'not '}there"
    left = _alive(working, _PATIENCE + _GRACE)
    return f"{len(left)} workers are left" if left else None


def torture(tally: Tally) -> None:
    """One goal a trial; the node is started again where a trial ended it."""
    bench: _Bench | None = None
    for number in tally.numbers():
        kind = _KINDS[number % len(_KINDS)]
        bench = bench or _Bench()
        with tempfile.TemporaryDirectory() as folder:
            problem = _trial(tally, bench, kind, tally.rng(number), Path(folder))
        tally.count(kind)
        if problem:
            tally.fail(f"{kind}: {problem}")
        if problem or bench.process.poll() is not None:
            bench.close()
            bench = None
    if bench is not None:
        bench.close()
