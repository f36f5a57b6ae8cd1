"""The commands: `psiu-broker` for the daemon, `psiu` for people."""
