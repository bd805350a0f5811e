"""Training of the keypoints: those that other views show again become more probable, the others less."""

import numpy as np
import pytest

from tests.learning.textures import textured

torch = pytest.importorskip("torch", reason="needs fcslam[train]")

from fcslam.errors import TrainingError  # noqa: E402
from fcslam.features.detector import BUNDLED_NETWORK  # noqa: E402
from fcslam.learning.federated.initial_weights import read_detector_weights  # noqa: E402
from fcslam.learning.federated.networks import weights_to_network  # noqa: E402
from fcslam.learning.local_training import LocalTrainingPlan, layer_names, network_from_state  # noqa: E402
from fcslam.learning.network import KeypointNetwork  # noqa: E402
from fcslam.learning.point_training import LOST_FACTOR, train_points, voted_targets  # noqa: E402
from fcslam.learning.revisit_batches import FEWEST_VOTED, VOTED_VIEWS, RevisitExamples, VotedImage, draw_voted, vote  # noqa: E402
from fcslam.learning.revisits import Sightings  # noqa: E402
from fcslam.learning.settings import TrainingSettings  # noqa: E402
from fcslam.learning.validation import detect  # noqa: E402

CPU = torch.device("cpu")
SMALL = TrainingSettings(steps=40)
IMAGE = textured(1, 96, 96)


@pytest.fixture(scope="module")
def light():
    return weights_to_network(read_detector_weights(BUNDLED_NETWORK, "light"), "light").state_dict()


@pytest.fixture(scope="module")
def voted(light):
    points, _ = detect(network_from_state("light", light), torch.from_numpy(IMAGE / np.float32(255.0))[None, None])
    inside = points[np.all((points > 8.0) & (points < 88.0), axis=1)].astype(np.float32)
    return VotedImage(0, inside, np.arange(len(inside)) % 2 == 0)


def strengths(state, points):
    """Largest score within a pixel of each point."""
    network = network_from_state("light", state)
    with torch.inference_mode():
        scores = network.scores(network(torch.from_numpy(IMAGE / np.float32(255.0))[None, None]))[0].numpy()
    return np.array([scores[y - 1 : y + 2, x - 1 : x + 2].max() for x, y in np.rint(points).astype(int)])


def test_keypoints_found_again_gain_and_others_lose(light, voted):
    assert len(voted.points) > 10
    done = train_points(light, RevisitExamples([IMAGE], voted=[voted]), SMALL, LocalTrainingPlan(0, 20), CPU)
    before, after = strengths(light, voted.points), strengths(done.network.state_dict(), voted.points)
    gains = np.log(after / before)
    assert np.median(gains[voted.is_found]) > np.median(gains[~voted.is_found]) + 0.5


@pytest.mark.parametrize("encoder", ["light", "vgg"])
def test_only_the_layers_of_the_keypoints_change(encoder, voted):
    torch.manual_seed(1)
    start = KeypointNetwork(encoder).state_dict()
    settings = SMALL.model_copy(update={"encoder": encoder})
    done = train_points(start, RevisitExamples([IMAGE], voted=[voted]), settings, LocalTrainingPlan(0, 3), CPU)
    network = done.network
    changed = {name for name, tensor in network.state_dict().items() if not torch.equal(start[name], tensor)}
    assert changed
    assert changed <= layer_names(network, network.point_layers)
    assert not any("running" in name for name in changed)
    image = torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        before = network_from_state(encoder, start)(image).code_logits
        assert torch.allclose(before, network(image).code_logits, atol=1e-5)


def test_targets_move_the_voted_keypoints_alone():
    initial = np.full((1, 32, 32), 0.01, np.float32)
    image = VotedImage(0, np.array([[8.2, 7.9], [20.0, 20.0], [0.0, 31.0]], np.float32), np.array([True, False, True]))
    found = voted_targets(initial, [image], (0, 0))[0]
    assert found[7:10, 7:10].sum() == pytest.approx(1.0)
    assert found[19:22, 19:22] == pytest.approx(0.01 * LOST_FACTOR)
    assert found[30:, :2] == pytest.approx(0.01 * 20.0)  # a corner: four pixels, and no gain beyond the largest
    assert np.count_nonzero(found != initial[0]) == 9 + 9 + 4
    assert (initial == np.float32(0.01)).all()
    shifted = voted_targets(initial[:, 6:, 3:], [image], (6, 3))[0]  # without the last point
    assert shifted[1:4, 4:7].sum() == pytest.approx(1.0)
    assert np.count_nonzero(shifted != np.float32(0.01)) == 9 + 9


@pytest.mark.parametrize("step", range(3))
def test_without_a_vote_the_initial_network_stays(light, step):
    """Steps shift the grid of cells, each in another way."""
    nobody = VotedImage(0, np.empty((0, 2), np.float32), np.empty(0, bool))
    plan = LocalTrainingPlan(step, 1)
    done = train_points(light, RevisitExamples([IMAGE], voted=[nobody]), SMALL, plan, CPU)
    voted_on = VotedImage(0, np.array([[40.0, 40.0]], np.float32), np.array([True]))
    moved = train_points(light, RevisitExamples([IMAGE], voted=[voted_on]), SMALL, plan, CPU)
    still, pull = (
        sum(float(value.abs().sum()) for name, value in each.optimiser_state.items() if name.endswith("exp_avg"))
        for each in (done, moved)
    )
    assert still < 0.05 * pull


def test_votes_need_enough_views_and_agreement():
    shown = np.repeat([2, 3, 4, 4, 8], FEWEST_VOTED)
    found = np.repeat([2, 0, 1, 2, 3], FEWEST_VOTED)
    points = np.random.default_rng(1).uniform(0, 96, (len(shown), 2)).astype(np.float32)
    image = vote(7, points, Sightings(shown, found))
    assert image.image == 7
    assert np.array_equal(image.points, points[FEWEST_VOTED : 4 * FEWEST_VOTED])  # two views are few, 3 of 8 is open
    assert image.is_found.tolist() == [False] * 2 * FEWEST_VOTED + [True] * FEWEST_VOTED
    few = slice(FEWEST_VOTED, 2 * FEWEST_VOTED - 1)
    assert vote(7, points[few], Sightings(shown[few], found[few])) is None


def test_batches_depend_on_the_seed_and_the_step_alone(voted):
    examples = RevisitExamples([IMAGE] * 9, voted=[VotedImage(k, voted.points, voted.is_found) for k in range(9)])
    drawn = [[each.image for each in draw_voted(examples, 1, step)] for step in range(20)]
    assert drawn == [[each.image for each in draw_voted(examples, 1, step)] for step in range(20)]
    assert all(len(each) == VOTED_VIEWS for each in drawn)
    assert len({number for each in drawn for number in each}) > 5
    assert draw_voted(RevisitExamples([IMAGE]), 1, 0) == []


def test_without_votes_there_is_one_line(light):
    with pytest.raises(TrainingError, match="there is none; set trained to codes"):
        train_points(light, RevisitExamples([IMAGE]), SMALL, LocalTrainingPlan(0, 1), CPU)
