"""What tightly coupled estimators share around their equations: start, standstill, failure, restart, status.

An estimator of this kind is a :class:`~vioframe.tight.fuser.TightFuser` that says how it begins from a state and
how one window of inertial samples and tracks moves it on; its options are in :mod:`vioframe.tight.options`.
"""
