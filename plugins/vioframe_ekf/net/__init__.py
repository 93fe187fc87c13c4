"""What works on tensors; only imported once torch is known to be there."""
