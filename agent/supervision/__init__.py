"""Reports how the agent is working: to systemd, in the gateway's status, to Prometheus and in the log."""
