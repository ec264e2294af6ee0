"""One reduced model that knows its error."""
