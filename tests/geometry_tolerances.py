"""The one table of how exact the geometry has to be."""

ROUNDING = 1e-12
"""Identities of closed forms on values of about one: some hundred roundings of 2e-16."""

NEAR_PI = 1e-7
"""The logarithm within a millionth of half a turn, where half the digits are gone."""

NUMERICAL = 1e-8
"""A central difference with step 1e-5 against a derivative: step² plus rounding over step."""

OPENCV_PIXELS = 1e-6
"""Pixels, against OpenCV's projection of the same point."""

UNDISTORTED = 1e-9
"""Normalised coordinates after distorting and undistorting inside the image."""

UNDISTORTED_CORNER = 1e-6
"""The same for strong distortion, whose fixed-point steps converge slowly at the corners."""

TRIANGULATED = 1e-9
"""Metres, of a point a few metres away seen without error."""
