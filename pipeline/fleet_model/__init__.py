"""What the vehicles of one model line share, and what each vehicle's answer is with and without it."""
