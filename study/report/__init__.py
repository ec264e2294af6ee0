"""The page of a result: sections, equations, files."""
