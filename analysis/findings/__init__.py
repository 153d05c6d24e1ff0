"""What a report can say: findings, the words of each kind, and alerts."""
