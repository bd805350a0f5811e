"""Packets between robots and the cloud, as bytes; docs/reference/wire.md describes the format."""
