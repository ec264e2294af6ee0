"""One reduced model with a bound or an estimate of its error."""
