import numpy as np

from pipeline.logs.clock import in_order


def test_stamps_that_run_backwards_are_sorted_and_counted():
    stamps = in_order(np.array([10, 20, 15, 30, 5]), np.array([1, 2, 3, 4, 5]))
    assert stamps.order.tolist() == [4, 0, 2, 1, 3]
    assert stamps.backwards == 2
    assert (stamps.repeated, stamps.zero) == (0, 0)


def test_of_equal_stamps_the_first_received_is_kept():
    stamps = in_order(np.array([10, 20, 20, 20]), np.array([1, 9, 7, 7]))
    assert stamps.order.tolist() == [0, 2]
    assert stamps.repeated == 2


def test_messages_without_a_stamp_are_left_out_and_counted():
    stamps = in_order(np.array([0, 10, -5, 20]), np.array([1, 2, 3, 4]))
    assert stamps.order.tolist() == [1, 3]
    assert stamps.zero == 2
    assert stamps.backwards == 0


def test_the_delay_is_receipt_minus_capture():
    time_ns = np.arange(1, 101) * 10**9
    stamps = in_order(time_ns, time_ns + 250_000_000)
    assert stamps.delay_s == 0.25
    assert stamps.spread_s == 0.0


def test_nothing_is_no_fault():
    stamps = in_order(np.zeros(0, np.int64), np.zeros(0, np.int64))
    assert len(stamps.order) == 0
