"""The networks, as tensors only; importing a module of this folder imports torch.

=================  ====================================================================
``encoders``       VGG, MobileNetV2 and GhostNet: an image to a map of an eighth of its size
``superpoint``     an encoder and the heads of detector and descriptors
``keypoints``      from what the heads say to points: heat, suppression, sampled descriptors
``layers``         what the others are built of
``fusing``         the same net with batch normalisation folded into its convolutions, for use
=================  ====================================================================
"""
