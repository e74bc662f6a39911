from kitting_drake.reproduction.page.markdown import markdown_table


def test_narrow_columns_have_a_rule_that_readers_know():
    """A rule of a colon alone makes a paragraph of the whole table."""
    table = markdown_table(["method", "N"], [["oracle", ""]])
    assert table == "| method |   N |\n| ------ | --: |\n| oracle |     |\n"
