"""Many machines: trainings, independent jobs and searches on a Ray cluster (extra `ray`)."""
