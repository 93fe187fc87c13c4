"""ORB keypoints matched by their binary descriptors, with lasting ids."""
