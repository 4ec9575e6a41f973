"""Drivers: one module for each way to reach a device; a module's software is imported when it is named."""
