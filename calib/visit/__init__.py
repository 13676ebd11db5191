"""What guides a person beside a sensor: the next position, the fewest stops, the clamp. Begin with `next_stop.py`."""
