"""What front ends share: grey images, points spread over them, outliers, the geometry of two cameras."""
