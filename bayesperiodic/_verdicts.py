"""Tones of verdicts: how a report shows what a diagnostic concludes."""

GOOD, CAUTION, BAD, NEUTRAL = "good", "caution", "bad", "neutral"
TONES: dict[str, str] = {}


def with_tone(verdict: str, tone: str) -> str:
    """Return a verdict and register its tone; verdicts without one have the tone CAUTION."""
    TONES[verdict] = tone
    return verdict
