"""What a robot sends to the cloud and back, as bytes; the format is written down in docs/reference/wire.md."""
