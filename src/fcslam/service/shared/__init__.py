"""Several instances of the service over one store on a PostgreSQL server."""
