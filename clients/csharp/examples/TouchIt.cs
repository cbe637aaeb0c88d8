// Presses the middle of a tissue: `TouchIt.exe URL SCENE SECONDS`. Prints one line of JSON.
using System;
using System.Diagnostics;
using System.Globalization;
using System.Threading;
using Palpate;

static class TouchIt
{
    static int Main(string[] arguments)
    {
        double seconds = double.Parse(arguments[2], CultureInfo.InvariantCulture);
        using (var server = new Server(arguments[0]))
        using (var session = server.Create(arguments[1]))
        {
            var options = TouchOptions.Default;
            options.Limits = Limits.Of("omega3");
            options.Limits.WorkspaceRadius = 1.0;
            options.InTissueFrame = true;
            using (var touch = session.Touch(options))
            {
                // Down from 5 mm above the middle until there is a force, then 3 mm further.
                var extent = session.Extent;
                double z = extent.Most.Z + 0.005, lowest = extent.Least.Z - 0.02, most = 0.0;
                var clock = Stopwatch.StartNew();
                int ticks = 0;
                for (; ticks < 1000 * seconds; ticks++)
                {
                    var place = new Vector(extent.Middle.X, extent.Middle.Y, z);
                    var force = touch.Tick(new Reading(place, true), clock.Elapsed.TotalSeconds).Force.Length;
                    if (most < 0.02 && force >= 0.02) lowest = z - 0.003;
                    most = Math.Max(most, force);
                    if (z > lowest) z -= 20e-6;
                    while (clock.Elapsed.TotalMilliseconds < ticks + 1) Thread.Sleep(0);
                }
                Console.WriteLine("{\"ticks\":" + ticks + ",\"force_max_n\":" + most.ToString("F4", CultureInfo.InvariantCulture) + "}");
            }
            session.Delete();
        }
        return 0;
    }
}
