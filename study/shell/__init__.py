"""From the command line to a command: session, standard streams, other programs, diagnosis."""
