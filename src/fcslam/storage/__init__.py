"""Files that are whole or not there, databases of SQLite and PostgreSQL, and the state of a program as a file."""
