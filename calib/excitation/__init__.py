"""The front end: where the sensor moves or rests, and which windows come of it. Begin with `front_end.py`."""
