"""The images that a robot keeps: the newest, never more than the limit."""

from hypothesis import given
from hypothesis import strategies as st

from fcslam.robot.views import MOST_BYTES, MOST_IMAGES, surplus

HUNDRED_IMAGES = MOST_BYTES // 100


@given(st.lists(st.sampled_from((1, HUNDRED_IMAGES, 8 * HUNDRED_IMAGES)), max_size=2 * MOST_IMAGES))
def test_the_newest_that_fit_are_kept(sizes):
    dropped = surplus(sizes)
    kept = sizes[dropped:]
    assert len(kept) <= MOST_IMAGES
    assert sum(kept) <= MOST_BYTES
    one_more = sizes[dropped - 1 :]
    assert not dropped or len(one_more) > MOST_IMAGES or sum(one_more) > MOST_BYTES
