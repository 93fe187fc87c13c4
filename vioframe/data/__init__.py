"""Where packets come from: the abstract recording, what recordings on disk share, and the simulator."""
