"""The networks, as tensors only; importing a module of this folder imports torch.

=================  ====================================================================
``googlenet``, ``resnet``, ``inception``  the temporal stream, with torchvision's parameter names
``backbones``      chooses one of them, widens its first convolution, loads ImageNet files
``two_stream``     TSVO: spatial and temporal stream, head
``deepvo``         FlowNetS features and two LSTM layers
=================  ====================================================================
"""
