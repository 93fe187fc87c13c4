"""Reading ahead: same packets, same errors at the same place, bounded, and the thread goes away."""

import threading
import time

import pytest

from vioframe.data.recording import prefetch
from vioframe.errors import DataError
from vioframe.types import Frame


def frames(count):
    for k in range(count):
        yield Frame(stamp_ns=k)


def reading_threads():
    return [thread for thread in threading.enumerate() if thread.name == "vioframe-prefetch"]


def test_packets_come_in_order():
    assert [p.stamp_ns for p in prefetch(frames(100), depth=3)] == list(range(100))


def test_a_readers_error_is_raised_where_it_happened():
    def broken():
        yield from frames(5)
        raise DataError("image 5 is gone")

    seen = []
    with pytest.raises(DataError, match="image 5"):
        for packet in prefetch(broken()):
            seen.append(packet.stamp_ns)
    assert seen == list(range(5))


def test_no_more_than_the_depth_is_read_ahead():
    given = []

    def counted():
        for frame in frames(1000):
            given.append(frame.stamp_ns)
            yield frame

    stream = prefetch(counted(), depth=4)
    next(stream)
    time.sleep(0.2)
    assert len(given) <= 7
    stream.close()


def test_leaving_early_stops_the_thread():
    stream = prefetch(frames(10**9), depth=2)
    next(stream)
    stream.close()
    assert not reading_threads()
