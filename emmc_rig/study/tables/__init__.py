"""The paper's tables and figures on given light fields, and tests of its claims."""
