"""Label sets and road users."""

import numpy as np
import pytest

from pipeline.core.rigs import TopicSemantics
from pipeline.perceive.labels import (
    CITYSCAPES,
    DETECTOR_SETS,
    LABEL_SETS,
    ROAD_ID,
    ROAD_USERS,
    SKY_ID,
    VOID_ID,
    road_user_name,
    to_cityscapes,
)


def test_cityscapes_labels_stay_as_they_are():
    table = to_cityscapes("cityscapes")
    assert np.array_equal(table[:19], np.arange(19))
    assert np.all(table[19:] == VOID_ID)


@pytest.mark.parametrize("label_set", LABEL_SETS)
def test_no_foreign_label_means_two_classes_and_all_names_are_known(label_set):
    ids = [i for group in LABEL_SETS[label_set].values() for i in group]
    assert len(ids) == len(set(ids))
    assert set(LABEL_SETS[label_set]) <= set(CITYSCAPES)
    assert to_cityscapes(label_set)[255] == VOID_ID


@pytest.mark.parametrize(
    ("label_set", "foreign", "name"),
    [
        ("ade20k", 6, "road"), ("ade20k", 2, "sky"), ("ade20k", 20, "car"), ("ade20k", 93, "pole"),
        ("ade20k", 7, None), ("coco", 148, "road"), ("coco", 156, "sky"), ("coco", 2, "car"),
        ("coco", 63, None),
    ],
)  # fmt: skip
def test_foreign_labels_mean_what_their_sets_say(label_set, foreign, name):
    assert to_cityscapes(label_set)[foreign] == (VOID_ID if name is None else CITYSCAPES.index(name))


@pytest.mark.parametrize(
    ("logged", "name"),
    [("car", "car"), ("Pedestrian", "person"), ("motor_bike", None), ("van", "car"), ("dog", None)],
)
def test_logged_class_names_become_road_users(logged, name):
    assert road_user_name(logged) == name


def test_detectors_know_only_road_users():
    for names in DETECTOR_SETS.values():
        assert set(names.values()) <= set(ROAD_USERS)


def test_labels_of_a_set_of_ones_own_mean_what_it_says_and_the_others_nothing():
    table = to_cityscapes({"road": (7, 8), "car": (26,)})
    assert table[[7, 8, 26]].tolist() == [ROAD_ID, ROAD_ID, CITYSCAPES.index("car")]
    assert set(np.delete(table, [7, 8, 26])) == {VOID_ID}


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({"label_set": {"street": [1]}}, "traffic light"),
        ({"label_set": {"road": [1], "car": [1]}}, "two meanings to 1"),
        ({"label_set": {"road": [256]}}, "255"),
        ({"classes": {"1": "cow"}}, "motorcycle"),
    ],
)
def test_a_set_of_ones_own_that_cannot_be_right_is_refused(own, said):
    with pytest.raises(ValueError, match=said):
        TopicSemantics(source="topics", labels="/l", detections="/d", **own)


def test_the_ids_of_the_named_sets_stay_those_of_cityscapes():
    assert CITYSCAPES[ROAD_ID] == "road"
    assert CITYSCAPES[SKY_ID] == "sky"
    assert [CITYSCAPES[i] for i in range(11, 19)] == list(ROAD_USERS)
