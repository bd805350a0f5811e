"""Binary features: 256-bit codes and the pictures they are taken from."""
