"""What scripts/driver_bridge is made of: the script, the processes it supervises, the recording."""
