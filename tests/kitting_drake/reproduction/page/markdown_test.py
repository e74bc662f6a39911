from kitting_drake.reproduction.page.markdown import markdown_table


def test_narrow_columns_have_a_rule_of_three_characters():
    """Some Markdown parsers reject a table with a shorter rule."""
    table = markdown_table(["method", "N"], [["oracle", ""]])
    assert table == "| method |   N |\n| ------ | --: |\n| oracle |     |\n"
