"""``softgrasp identify --suggest-markers``: where to measure, before anything is measured."""
