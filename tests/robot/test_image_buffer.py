"""The images that a robot keeps: the newest, never more than the limit."""

from hypothesis import given
from hypothesis import strategies as st

from fcslam.robot.keyframe_folder import MOST_BYTES, MOST_IMAGES, ImageBuffer, KeyframeImage

HUNDRED_IMAGES = MOST_BYTES // 100


@given(st.lists(st.sampled_from((1, HUNDRED_IMAGES, 8 * HUNDRED_IMAGES)), max_size=2 * MOST_IMAGES))
def test_the_newest_that_fit_are_kept(sizes):
    contents = {size: bytes(size) for size in set(sizes)}
    image_buffer = ImageBuffer()
    for number, size in enumerate(sizes):
        image_buffer.add(KeyframeImage(number, contents[size], None, None, None))
    kept = [shot.keyscan for shot in image_buffer]
    assert kept == list(range(len(sizes) - len(kept), len(sizes)))
    assert len(kept) <= MOST_IMAGES
    assert sum(sizes[number] for number in kept) <= MOST_BYTES
    if len(kept) < len(sizes):  # one more would not have fitted, now or when it was let go of
        latest = [sizes[: end + 1][-len(kept) - 1 :] for end in range(len(kept), len(sizes))]
        assert any(len(some) > MOST_IMAGES or sum(some) > MOST_BYTES for some in latest)
