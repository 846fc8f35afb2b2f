"""The instrument in use: its equation solved for the stimulus, the uncertainty budget, exports, firmware parameters."""
