"""`fieldcal keys`: certificates for Zenoh over TLS, and the keys that sign commands."""
