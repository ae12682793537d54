"""From a chaotic recording to unstable periodic orbits with error bars."""
