# SPDX-License-Identifier: Apache-2.0
"""The executor serves whatever rclpy's own serves."""

from __future__ import annotations

import time

import pytest
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.task import Future
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from suspension_twin.nodes._executor import TwinExecutor
from suspension_twin.nodes._main import ros_context


def answer(_request, response):
    response.success = True
    return response


def test_messages_arrive_all_and_in_order(bench):
    heard: list[int] = []
    bench.side.create_subscription(Int64, "numbers", lambda m: heard.append(m.data), 1000)
    say = bench.speak(Int64, "numbers")
    for k in range(300):
        say(Int64(data=k))
    bench.until(lambda: len(heard) == 300)
    assert heard == list(range(300))


def test_a_timer_is_called_at_its_period_while_messages_pour_in(bench):
    calls: list[float] = []
    bench.side.create_timer(0.02, lambda: calls.append(time.monotonic()))
    bench.side.create_subscription(Int64, "flood", lambda _: None, 1000)
    say = bench.speak(Int64, "flood")
    calls.clear()
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        say(Int64())
        bench.executor.spin_once(timeout_sec=0.001)
    assert 15 <= len(calls) <= 26


def test_services_are_answered_while_messages_pour_in(bench):
    bench.side.create_service(Trigger, "ask", answer)
    bench.side.create_subscription(Int64, "flood", lambda _: None, 1000)
    say = bench.speak(Int64, "flood")
    client = bench.side.create_client(Trigger, "ask")
    bench.until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    for _ in range(2000):
        say(Int64())
        bench.executor.spin_once(timeout_sec=0.0)
        if future.done():
            break
    assert future.done() and future.result().success


def test_entities_may_come_and_go_while_it_spins(bench):
    heard: list[int] = []
    say = None

    def first(message: Int64) -> None:
        heard.append(message.data)
        if message.data == 1:
            bench.side.destroy_subscription(subscription)
            bench.side.create_subscription(Int64, "late", lambda m: heard.append(100 + m.data), 10)

    subscription = bench.side.create_subscription(Int64, "early", first, 10)
    say = bench.speak(Int64, "early")
    for k in range(3):
        say(Int64(data=k))
    bench.until(lambda: 1 in heard)
    bench.spin(0.1)
    assert heard == [0, 1]
    bench.speak(Int64, "late")(Int64(data=7))
    bench.until(lambda: 107 in heard)


def test_a_coroutine_waits_for_a_future_set_by_a_timer(bench):
    future: Future = Future(executor=bench.executor)
    seen: list[str] = []

    async def work() -> str:
        seen.append(await future)
        return "done"

    task = bench.executor.create_task(work)
    timer = bench.side.create_timer(0.05, lambda: future.set_result("now"))
    bench.until(task.done, seconds=5.0)
    bench.side.destroy_timer(timer)
    assert seen == ["now"] and task.result() == "done"


def test_an_asynchronous_subscription_is_served(bench):
    heard: list[int] = []

    async def later(message: Int64) -> None:
        heard.append(message.data)

    bench.side.create_subscription(Int64, "async", later, 10)
    bench.speak(Int64, "async")(Int64(data=3))
    bench.until(lambda: heard == [3])


def test_message_info_is_handed_over_where_it_is_asked_for(bench):
    heard: list[int] = []
    bench.side.create_subscription(Int64, "info", lambda m, info: heard.append(info["source_timestamp"]), 10)
    bench.speak(Int64, "info")(Int64())
    bench.until(lambda: heard and heard[0] > 0)


def test_a_guard_condition_calls_its_callback_once(bench):
    calls: list[int] = []
    guard = bench.side.create_guard_condition(lambda: calls.append(1))
    guard.trigger()
    bench.until(lambda: calls)
    bench.spin(0.1)
    assert calls == [1]


def test_spinning_until_a_future_is_done(bench):
    bench.side.create_service(Trigger, "ask", answer)
    client = bench.side.create_client(Trigger, "ask")
    bench.until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    bench.executor.spin_until_future_complete(future, timeout_sec=10.0)
    assert future.result().success


def test_an_exception_of_a_callback_is_raised_from_spin_once(bench):
    def broken(_message: Int64) -> None:
        raise ValueError("broken")

    bench.side.create_subscription(Int64, "broken", broken, 10)
    bench.speak(Int64, "broken")(Int64())
    with pytest.raises(ValueError, match="broken"):
        bench.spin(5.0)


def test_it_returns_in_time_when_nothing_happens(bench):
    bench.spin(0.2)
    began = time.monotonic()
    bench.executor.spin_once(timeout_sec=0.1)
    assert time.monotonic() - began < 5.0
    began = time.monotonic()
    bench.executor.spin_once(timeout_sec=0.0)
    assert time.monotonic() - began < 5.0


def test_a_context_shut_down_ends_it():
    with ros_context([]) as context:
        executor = TwinExecutor(context=context)
        node = rclpy.create_node("one", context=context)
        executor.add_node(node)
        executor.spin_once(timeout_sec=0.0)
        context.shutdown()
        with pytest.raises(ExternalShutdownException):
            executor.spin_once(timeout_sec=1.0)
        executor.shutdown()
        executor.spin_once(timeout_sec=1.0)  # nothing, at once
        node.destroy_node()


def test_a_node_taken_off_is_served_no_more(bench):
    heard: list[int] = []
    other = rclpy.create_node("other", context=bench.context)
    other.create_subscription(Int64, "numbers", lambda m: heard.append(m.data), 10)
    bench.executor.add_node(other)
    say = bench.speak(Int64, "numbers")
    say(Int64(data=1))
    bench.until(lambda: heard == [1])
    bench.executor.remove_node(other)
    say(Int64(data=2))
    bench.spin(0.2)
    assert heard == [1]
    other.destroy_node()
