"""The networks, as tensors only; importing a module of this folder imports torch.

=================  ====================================================================
``encoders``       VGG, MobileNetV2 and GhostNet: an image to a map of an eighth of its size
``superpoint``     an encoder and the heads of detector and descriptors
``keypoints``      from what the heads say to points: heat, suppression, sampled descriptors
``layers``         what the others are built of
``inference``      the same net for use: folded normalisation, descriptors where points are and nowhere else
=================  ====================================================================
"""
