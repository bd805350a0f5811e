"""Decoded messages of a bag in a temporary file."""

from fcslam.sources.bags.tape import Tape


def test_a_damaged_time_of_recording_is_kept_however_large_it_is():
    tape = Tape()
    tape.add(3, 2**64 - 1, ValueError("damaged"))
    tape.finish()
    ((topic, time_ns, content),) = tape.read({3})
    assert (topic, time_ns, str(content)) == (3, 2**64 - 1, "damaged")
