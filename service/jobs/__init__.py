"""Jobs at work: admission, the worker, its processes, events, expiry and recovery."""
