"""How many examples property tests try: few in ``make test``, all of them in ``make test-all``."""

from hypothesis import HealthCheck, settings

SHARE, LEAST = 0.1, 10
"""Share of the examples that ``make test`` tries, and the smallest number."""

COMMON = {
    "deadline": None,  # whether a test passes must not depend on the speed of the machine
    "derandomize": True,
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}

settings.register_profile("quick", max_examples=20, **COMMON)
settings.register_profile("thorough", max_examples=100, **COMMON)
settings.load_profile("quick")  # pytest's option --hypothesis-profile is read later


def thorough():
    """Whether all examples are wanted."""
    return settings.get_current_profile_name() == "thorough"


def examples(count):
    """Return Hypothesis settings for a test that is worth ``count`` examples."""
    return settings(max_examples=count if thorough() else max(LEAST, round(SHARE * count)))
