"""The images that a robot keeps: the newest, never more than the limit."""

from hypothesis import given
from hypothesis import strategies as st

from fcslam.robot.image_buffer import ImageBuffer, ImageBufferConfig, KeyframeImage


@given(st.lists(st.integers(0, 3_000_000), max_size=30), st.integers(0, 8), st.floats(0.0, 10.0))
def test_the_newest_that_fit_are_kept(sizes, most, megabytes):
    image_buffer = ImageBuffer(ImageBufferConfig(most_images=most, most_megabytes=megabytes))
    for number, size in enumerate(sizes):
        image_buffer.add(KeyframeImage(number, bytes(size), None, None, None))
    kept = [shot.keyscan for shot in image_buffer]
    assert kept == list(range(len(sizes) - len(kept), len(sizes)))
    assert len(kept) <= most
    assert sum(sizes[number] for number in kept) <= 1e6 * megabytes
    if len(kept) < len(sizes):  # one more would not have fitted, now or when it was let go of
        latest = [sizes[: end + 1][-len(kept) - 1 :] for end in range(len(kept), len(sizes))]
        assert any(len(some) > most or sum(some) > 1e6 * megabytes for some in latest)
