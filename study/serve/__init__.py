"""``softgrasp serve``: a certified model behind UM-Bridge's protocol, for tools of uncertainty quantification."""
