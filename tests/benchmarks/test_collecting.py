"""What collecting costs: processor time of all processes counts, and the price of a policy is its bytes."""

import multiprocessing
import time

from benchmarks.collecting import LEARNERS, price, processor_seconds


def test_the_price_of_a_policy_is_two_matrices_for_each_learner_and_little_else():
    found = price(budget=20, repeats=1)
    assert found["basis"] >= 20
    matrices = LEARNERS * 2 * 8 * found["basis"] ** 2
    assert matrices < found["bytes"] < 4 * matrices
    assert found["read_ms"] > 0


def busy(seconds: float, ready) -> None:
    while time.process_time() < seconds:
        pass
    ready.set()
    time.sleep(60)


def test_what_children_use_is_counted():
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    before = processor_seconds()
    child = context.Process(target=busy, args=(0.3, ready))
    child.start()
    ready.wait()
    used = processor_seconds() - before
    child.kill()
    child.join()
    assert used > 0.25
