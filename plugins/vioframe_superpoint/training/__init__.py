"""How the net is trained: corners of drawn shapes, then labels for pictures, then detector and descriptors together.

==============  =======================================================================================
``options``     ``frontend.training`` and ``descriptor_loss``, without torch
``stages``      the whole training, stage by stage, and what is kept of it; ``cards``: what is told of that
``losses``      of the detector, and three of the descriptors
``pairs``       two views of a picture in different light, without torch
``labels``      labelled pictures on disk, and points as classes of cells
``adaptation``  homographic adaptation of one picture; ``labelling``: of all of them; ``sources``: which they are
``data``        batches by the number of their iteration
``steps``       the loss of a step; ``schedule``: the learning rate; ``loop``: a stage; ``bar``: on the terminal
``validation``  how good the net is while it learns; ``drawing``: what it finds
==============  =======================================================================================
"""

from vioframe_superpoint.training.options import (
    AdaptationOptions,
    DenseLoss,
    DescriptorLoss,
    PairOptions,
    PictureOptions,
    ShapesOptions,
    SparseHingeLoss,
    SparseTripletLoss,
    TrainingOptions,
)

__all__ = [
    "AdaptationOptions",
    "DenseLoss",
    "DescriptorLoss",
    "PairOptions",
    "PictureOptions",
    "ShapesOptions",
    "SparseHingeLoss",
    "SparseTripletLoss",
    "TrainingOptions",
]
