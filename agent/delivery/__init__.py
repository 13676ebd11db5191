"""Delivery of results: the store, which is also the outbox; publication over Zenoh; the consumer's client library."""
