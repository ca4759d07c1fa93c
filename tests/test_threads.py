"""Work shared out among threads: the order of its results, its failures, and one core."""

import threading
import time

import pytest

from pipeline import threads


@pytest.mark.parametrize("cores", [1, 2, 5])
def test_results_come_in_the_order_of_the_work(cores, monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: cores)

    def slow_at_first(i):
        time.sleep(0.01 if i < 3 else 0.0)
        return i * i

    assert threads.each(slow_at_first, range(20)) == [i * i for i in range(20)]


@pytest.mark.parametrize("cores", [1, 2])
def test_what_fails_is_raised_and_the_rest_is_not_begun(cores, monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: cores)
    done = []

    def third_fails(i):
        if i == 2:
            raise ValueError("third")
        done.append(i)

    with pytest.raises(ValueError, match="third"):
        threads.each(third_fails, range(100))
    assert len(done) < 10


def test_work_within_work_is_done_by_who_asks(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2)

    def outer(_):
        return set(threads.each(lambda _: threading.get_ident(), range(8))) == {threading.get_ident()}

    assert all(threads.each(outer, range(8)))


def test_one_core_starts_no_thread(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 1)
    assert set(threads.each(lambda _: threading.get_ident(), range(3))) == {threading.get_ident()}
