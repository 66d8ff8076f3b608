"""The ``sb3-sap`` command. Nothing imports it."""
