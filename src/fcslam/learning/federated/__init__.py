"""Federated training: robots train the detector on their own images, and only weights leave them."""
