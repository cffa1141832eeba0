"""How many random examples a test looks at: few, or under `make test-all` many more."""

import os

from hypothesis import settings

_TIMES = 10 if os.environ.get("DIFFTETVR_TESTS") == "thorough" else 1


def examples(count):
    """Settings for `count` examples, times ten where tests are to be thorough."""
    return settings(max_examples=_TIMES * count, deadline=None)
