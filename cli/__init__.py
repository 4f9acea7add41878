"""The command line: `verbs` is the table of verbs, `words` turns words into their options, `console` talks."""
