"""MCAP logs in and out: messages, reading with recovery, the clock, writing."""
