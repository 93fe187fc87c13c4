"""What works on tensors; imported when a net is made, since torch is slow to import."""
