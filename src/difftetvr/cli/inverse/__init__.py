"""Which commands solve inverse problems that are no photographs? ``difftetvr viewpoint | fit-transfer``."""
