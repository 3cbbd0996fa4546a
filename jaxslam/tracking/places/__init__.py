"""Places: submaps of a map, and what is known again, by a camera that was lost or closes a loop."""
