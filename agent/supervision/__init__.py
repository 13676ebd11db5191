"""How the agent tells others that it is well: systemd, the gateway's status, Prometheus, the log."""
