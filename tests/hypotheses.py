"""How many examples a test looks at: few, the same in every run; or under `make test-all` many more, random ones."""

import os

from hypothesis import settings

_IS_THOROUGH = os.environ.get("DIFFTETVR_TESTS") == "thorough"


def examples(count):
    """Settings for `count` examples, times ten where tests are to be thorough."""
    return settings(max_examples=10 * count if _IS_THOROUGH else count, deadline=None, derandomize=not _IS_THOROUGH)
