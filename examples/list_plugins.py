"""List the installed tasks with what they measure, and the robots that can do them."""

from naospec import plugins

for name, task in plugins.usable(plugins.TASKS):
    description = task.describe()
    robots = [robot.name for _, robot in plugins.usable(plugins.ROBOTS) if task.supports(robot)]
    print(
        f"{name}: {description['summary']} Results: {', '.join(description['headline'])}. Robots: {', '.join(robots)}"
    )
