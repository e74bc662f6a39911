"""Policies: their demonstrations, networks and losses. There is no pydrake here."""
