"""Plans that keep obstacles and limits: a bound of what the reduced plant leaves out, a small quadratic program."""
