"""The tilted table and what acts on it: gravity, the tide, and every temperature."""
