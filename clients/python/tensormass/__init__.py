"""SDK of the Tensormass simulation server."""
