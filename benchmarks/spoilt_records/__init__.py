"""Records spoilt as files from a laboratory are: answered rightly, said to be spoilt, or silently wrong."""
