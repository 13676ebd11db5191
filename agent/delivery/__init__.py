"""What leaves the gateway: the store that is also the outbox, and Zenoh on both sides."""
