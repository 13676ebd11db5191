"""The calibration certificate: what it states, and its forms PDF, HTML, DCC XML and JSON."""
