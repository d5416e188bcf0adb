"""What a user meets: the command line, the report, pictures, files for other programs, words for missing devices."""
