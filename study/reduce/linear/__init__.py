"""Linear reduced models: every basis at every N."""
