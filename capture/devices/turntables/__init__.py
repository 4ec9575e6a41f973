"""Drivers of turntables: ASCII controllers by dialect file, Standa, EPICS motor records, and a simulated one."""
