"""Label sets and road users."""

import pytest

from pipeline.core.rigs import TopicSemantics
from pipeline.perceive.labels import (
    CITYSCAPES,
    DETECTOR_SETS,
    LABEL_SETS,
    ROAD_USERS,
    VOID_ID,
    to_cityscapes,
)  # fmt: skip


@pytest.mark.parametrize("label_set", LABEL_SETS)
def test_no_foreign_label_means_two_classes_and_all_names_are_known(label_set):
    ids = [i for group in LABEL_SETS[label_set].values() for i in group]
    assert len(ids) == len(set(ids))
    assert set(LABEL_SETS[label_set]) <= set(CITYSCAPES)
    assert to_cityscapes(label_set)[255] == VOID_ID
    assert all(set(names.values()) <= set(ROAD_USERS) for names in DETECTOR_SETS.values())


@pytest.mark.parametrize(
    ("label_set", "known"),
    [
        ("cityscapes", dict(enumerate(CITYSCAPES)) | {19: None}),
        ("ade20k", {6: "road", 2: "sky", 20: "car", 93: "pole", 7: None}),
        ("coco", {148: "road", 156: "sky", 2: "car", 63: None}),
        ({"road": (7, 8), "car": (26,)}, {7: "road", 8: "road", 26: "car", 0: None, 9: None, 255: None}),
    ],
    ids=["cityscapes", "ade20k", "coco", "one's own"],
)
def test_foreign_labels_mean_what_their_sets_say(label_set, known):
    table = to_cityscapes(label_set)
    for foreign, name in known.items():
        assert table[foreign] == (VOID_ID if name is None else CITYSCAPES.index(name))


@pytest.mark.parametrize(
    "own",
    [
        {"label_set": {"street": [1]}},
        {"label_set": {"road": [1], "car": [1]}},
        {"label_set": {"road": [256]}},
        {"classes": {"1": "cow"}},
    ],
)
def test_a_set_of_ones_own_that_cannot_be_right_is_refused_by_key(own):
    with pytest.raises(ValueError, match=next(iter(own))):
        TopicSemantics(source="topics", labels="/l", detections="/d", **own)
