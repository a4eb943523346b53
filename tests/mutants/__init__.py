"""Mutation testing of the safety rules: each rule is broken in every small way, and a test has to notice."""
