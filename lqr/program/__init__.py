"""Plans again, online: the quadratic program of a plan from any state near its way, and what decides on its answer."""
