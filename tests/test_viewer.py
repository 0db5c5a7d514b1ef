"""Keys of the viewer -> commands."""

from legged.rl.viewer import BACKSPACE, COMMA, DOWN, LEFT, RIGHT, SPACE, UP, Keyboard


def test_each_key_moves_its_own_axis_by_its_step():
    keyboard = Keyboard([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
    for key in (UP, UP, UP, DOWN, COMMA, LEFT, LEFT, RIGHT):
        keyboard.press(key)
    assert keyboard.command == [0.2, 0.1, 0.2]
    keyboard.press(SPACE)
    assert keyboard.command == [0.0, 0.0, 0.0]


def test_commands_stay_inside_the_trained_ranges():
    keyboard = Keyboard([-0.25, -1.0, -1.0], [0.35, 1.0, 1.0])
    for _ in range(9):
        keyboard.press(UP)
    assert keyboard.command[0] == 0.35
    for _ in range(9):
        keyboard.press(DOWN)
    assert keyboard.command[0] == -0.25


def test_other_keys_do_nothing_and_backspace_asks_for_a_new_start():
    keyboard = Keyboard([-1.0] * 3, [1.0] * 3)
    keyboard.press(ord("Q"))
    assert keyboard.command == [0.0, 0.0, 0.0]
    assert not keyboard.restart
    keyboard.press(BACKSPACE)
    assert keyboard.restart
