"""The software on a robot: sensor records in, numbered packets out."""
