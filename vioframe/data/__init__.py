"""Where packets come from: the abstract recording, and the simulator."""
