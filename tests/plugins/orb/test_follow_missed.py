"""Points that no keypoint matches, seen by the whole front end."""

import numpy as np

from vioframe.testing import make_scene
from vioframe.vision.keypoints import Keypoints
from vioframe_orb import OrbFrontend


def run(*, follow_missed):
    """Ids in an image before, and in one in which the detector finds nothing."""
    scene = make_scene()
    part = OrbFrontend(follow_missed=follow_missed)
    part.setup(scene.rig)
    for frame in scene.frames[:3]:
        before = part.process(frame)
    grays = part.gray_images(scene.frames[3])
    nothing = Keypoints(pixels=np.zeros((0, 2)), scores=np.zeros(0), descriptors=np.zeros((0, 32), np.uint8))
    return before.tracks, part.follow(scene.frames[3], grays, [nothing], None).tracks


def test_a_detector_that_finds_nothing_does_not_end_tracks_whose_patches_are_there():
    before, after = run(follow_missed=True)
    assert np.isin(before.ids, after.ids).mean() > 0.8
    # One that was absent already may come back, but nothing new begins.
    assert after.ids.max() <= before.ids.max()
    assert after.descriptors.shape == (len(after), 32)


def test_without_following_it_does():
    before, after = run(follow_missed=False)
    assert len(before) > 50 and len(after) == 0
