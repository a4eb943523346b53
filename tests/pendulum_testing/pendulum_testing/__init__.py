"""What the tests of several packages share: fixtures, and makers of plants, policies, recordings and bags."""
