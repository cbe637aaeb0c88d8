//! The program `palpate`: parses its arguments and calls one function.

mod program;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
#[cfg(windows)]
use program::service;
use program::{
    Failure, certificate, check, client, fit, journal, mesh, organ, render, run, say, serve, texture, token,
    within_memory,
};

/// A server for touching soft tissue over a network.
#[derive(Parser)]
#[command(version, about, max_term_width = 100)]
struct ServerArguments {
    #[command(subcommand)]
    command: ServerCommand,
}

#[derive(Subcommand)]
enum ServerCommand {
    /// Play a script on a scene, offline and as fast as possible, and write the records as JSON Lines; or indent the
    /// tissue, and print force over depth
    #[command(after_help = "Examples:\n  \
        palpate run paper vertical-60\n  \
        palpate run liver press --output press.jsonl --plot\n  \
        palpate run prostate indent --depth-mm 2 --output curve.csv\n  \
        palpate run liver stroke --output stroke.jsonl --score stroke.json --force-limit-n 2\n  \
        palpate run my-scene.toml my-script.toml --output poke.jsonl --set stepping.integrator=lagged\n\n\
        Exit status: 0; 1 when the run failed; 2 when an input was refused.")]
    Run(run::RunArguments),
    /// Report the properties and the cost of a scene: size, mass, stiffness under a fingertip, time to rest,
    /// integrator, expected error, time per step, sessions per core; warn about unlikely values
    #[command(after_help = "Examples:\n  \
        palpate check paper\n  \
        palpate check my-scene.toml my-script.toml\n  \
        palpate check my-scene.toml --set stepping.tolerance=1e-8\n\n\
        The row `deepest` is the force that presses a disc of 5 mm radius in by half the shorter side, or as far as \
        the force law reaches.\n\n\
        Exit status: 0, with warnings too; 2 when an input was refused.")]
    Check(check::CheckArguments),
    /// Fit the parameters of a scene to measured curves of force over depth, and write the scene: Young's modulus, Poisson's ratio,
    /// viscosity and branches of a solid; stiffness, foundation and damping of a mesh or a sheet
    #[command(after_help = "Examples:\n  \
        palpate fit curves.csv phantom --tip sphere --radius-mm 6 --output fitted.toml --plot fit.svg\n  \
        palpate fit curves.csv my-scene.toml --parameter material.youngs_modulus_pa\n  \
        palpate fit curves.csv liver --json\n\n\
        Each curve is a press of a tip: its depth is imposed over time in runs of the tissue, and the forces are compared. \
        docs/fitting.md describes the table and the result. Prints each parameter with its 95 % interval; one that the curves \
        can't tell keeps its value, or is refused if --parameter names it.\n\n\
        Exit status: 0; 1 when the fit failed or a file can't be written; 2 when an input was refused, or the curves can't tell a \
        parameter that --parameter names.")]
    Fit(fit::FitArguments),
    /// Draw a tissue while a script acts on it, without a screen: a PNG image of one moment, or a GIF of the whole script
    #[command(after_help = "Examples:\n  \
        palpate render paper oblique-100 --output poke.png\n  \
        palpate render paper vertical-60 --output mesh.png --wireframe --refine 1 --at-s 0.3 --camera 0,25\n  \
        palpate render liver my-script.toml --output poke.gif --size 480x360 --frames-hz 20\n\n\
        The scene's section [appearance] defines the texture. An arrow at its control point shows each force.\n\n\
        Exit status: 0; 1 when the run failed or the file can't be written; 2 when an input was refused.")]
    Render(render::RenderArguments),
    /// Paint an image for a tissue's surface: the lining of a stomach as an endoscope shows it
    #[command(after_help = "Examples:\n  \
        palpate texture --output mucosa.png\n  \
        palpate texture --seed 7 --size 4096 --output mucosa.png\n\n\
        The same seed and size give the same bytes; another size gives the same tissue at another resolution. To use \
        a texture in a scene, set texture_seed and texture_size in its section [appearance], or texture = \
        \"FILE.png\".\n\n\
        Exit status: 0; 1 when the file can't be written; 2 when an input was refused.")]
    Texture(texture::TextureArguments),
    /// Check a mesh of an organ: size, holes, volume, evenness and flaws; repair it, make it coarser, write it to
    /// another file
    #[command(after_help = "Examples:\n  \
        palpate mesh liver.obj --unit mm\n  \
        palpate mesh scan.stl --unit mm --repair --vertices 5000 --output liver.obj\n  \
        palpate mesh organ.msh --unit 0.0254 --json\n  \
        palpate mesh scan.seg.nrrd --label 3 --output liver.obj\n\n\
        Reads OBJ, STL, PLY, glTF (.gltf and .glb), Gmsh 1, 2 and 4.1 (.msh), VTK (.vtk, .vtp and .vtu), MEDIT (.mesh \
        and .meshb), TetGen (.node and .ele) and Abaqus (.inp). A volume mesh gives its outer surface. Of a label map of \
        a scan, NRRD (.nrrd), NIfTI (.nii and .nii.gz) or a segmentation of DICOM (.dcm), --label chooses what to read \
        the surface of. Mesh files do not state their unit, so you do: m, cm, mm, or the metres of one unit. Places in \
        the report are in that unit.\n\n\
        As for a scene, vertices at one position are joined along the edges of their triangles, closed surfaces are \
        turned outward, and duplicate triangles are removed; the report lists these changes. Vertices are numbered \
        from 0 in the order of the file.\n\n\
        A tissue needs a surface in which each edge has one or two triangles. --repair also welds vertices that are \
        nearly at one position, drops triangles without area, pairs triangles at edges of more than two, keeps the \
        largest surface with the surfaces inside it, fills small holes and drops unused vertices. It reports the \
        repairs, and area and volume before and after.\n\n\
        With --json: vertices, triangles, components, holes, area_m2, volume_m3, before, faults, extent_m, problems \
        with what, element and place_m, and more.\n\n\
        Exit status: 0 when the mesh is usable, with warnings too; 1 when a file can't be written, or when the \
        result of --repair or --vertices is not as requested: more than 1 % of area or volume lost, a closed surface \
        open, still refused, too many vertices; 2 when the mesh was refused.")]
    Mesh(mesh::MeshArguments),
    /// Make the mesh of an organ: gallbladder, liver, kidney, stomach, prostate, a segment of colon, a patch with lumps,
    /// or a phantom
    #[command(after_help = "Examples:\n  \
        palpate organ --list\n  \
        palpate organ gallbladder --output gallbladder.obj\n  \
        palpate organ liver --edge-mm 1.5 --seed 7 --output liver.obj\n\n\
        The file is in metres (unit = \"m\"). It has texture coordinates, and named groups of vertices such as \
        `rim`, which a scene can fix or make stiffer. The same name, edge length and seed give the same bytes; \
        another seed gives another shape.\n\n\
        An organ has about 1.15·area/edge² vertices, at most 500,000. The colon and the patch are open, with one \
        layer of triangles; the colon faces inward, because it is touched from inside. The other organs are closed \
        and face outward.\n\n\
        Exit status: 0; 1 when the file can't be written; 2 when an input was refused.")]
    Organ(organ::OrganArguments),
    /// Serve tissue over gRPC and to browsers: sessions in real time, commands in, forces and frames out
    #[command(after_help = "Examples:\n  \
        palpate serve\n  \
        palpate serve --listen 127.0.0.1:0 --scenes my-scenes --threads 1\n  \
        (umask 077; palpate token --name ann --role create,touch --tokens tokens.toml > ann.token)\n  \
        palpate serve --listen 0.0.0.0:7117 --tls-cert server.pem --tls-key server.key --tokens tokens.toml\n  \
        palpate-client replay vertical-60 --server https://server:7117 --token-file ann.token\n\n\
        The server prints its address to the standard output when it is ready. Ctrl-C or SIGTERM ends it: all \
        streams end with the reason, and the server cuts those that remain after the deadline.\n\n\
        On a loopback address every caller may do everything. At any other address the server starts only with TLS \
        and with tokens or client certificates, or with --insecure. A client sends its token with every call, as \
        `authorization: Bearer TOKEN`. Roles are watch, touch (hold a tool, change the tissue), create (create, \
        start, pause and delete sessions) and administer (everything, including the list of sessions). Health, \
        reflection and the page's files need no token; to give the page a token, open \
        https://server:7117/#token=TOKEN.\n\n\
        The server checks certificates, keys and tokens twice a second, and at once on SIGHUP. Valid changes take \
        effect at once for new connections and calls. Invalid files are logged and the old ones stay in use; for \
        tokens, the health service `palpate.tokens` reports it.")]
    Serve(Box<serve::ServeArguments>),
    /// Run the server as a service of Windows, which starts with the system: install it, remove it
    #[cfg(windows)]
    #[command(after_help = "Examples:\n  \
        palpate service install --folder C:\\palpate -- --config palpate.toml\n  \
        sc.exe start palpate\n  \
        sc.exe query palpate\n  \
        sc.exe stop palpate\n  \
        palpate service remove\n\n\
        `sc.exe stop` and the end of Windows end the server as Ctrl-C does. The log is in palpate.log, in the folder; \
        the reason why a server did not start is there too. After a crash Windows starts the service again.\n\n\
        Exit status: 0; 1 when the service control manager refused; 2 when an input was refused.")]
    Service(service::ServiceArguments),
    /// Work with the journals that `palpate serve --journal DIR` writes: list, show, verify, replay, draw, export,
    /// cut and recover them
    #[command(after_help = "Examples:\n  \
        palpate journal list journals\n  \
        palpate journal verify journals/*.mcap\n  \
        palpate journal show journals/SESSION.1.mcap\n  \
        palpate journal replay journals/SESSION.1.mcap --point 15,15 --output records.jsonl\n  \
        palpate journal replay journals/SESSION.1.mcap --server http://127.0.0.1:7117 --speed 2\n  \
        palpate journal render journals/SESSION.1.mcap --output film.gif\n  \
        palpate journal export journals/SESSION.1.mcap --format mcap --output foxglove.mcap\n  \
        palpate journal cut journals/SESSION.1.mcap --from 20000 --to 30000 --output case.mcap\n  \
        palpate journal recover journals/SESSION.1.mcap\n  \
        palpate journal key journal.key\n\n\
        A journal is an MCAP file, SESSION.RUN.mcap, one for each run of the server. It contains the scene, every \
        input with the step at which it took effect, hashes, snapshots, and the places of the tools and the forces \
        on them. The same inputs give the same bits; `verify` checks this, and reports the number of steps for which \
        a hash proves it. Only a signature proves that nobody has changed a file: `palpate journal key` and `palpate \
        serve --journal-key` sign, `verify --signed-by` checks.\n\n\
        Exit status: 0; 1 when a journal differs or a file can't be written; 2 when an input was refused.")]
    Journal(journal::JournalArguments),
    /// Create a token for clients of a server; prints the token once and stores only its hash
    #[command(after_help = "Examples:\n  \
        (umask 077; palpate token --name ann --role create,touch --tokens tokens.toml > ann.token)\n  \
        palpate token --name screen --role watch\n\n\
        Roles: watch (every role includes it), touch (hold a tool, change the tissue), create (create, start, pause \
        and delete sessions), administer (everything). `umask 077` makes the file of a token unreadable for other \
        users of this machine. To revoke a token, delete its entry; the server notices within 1 s.")]
    Token(token::TokenArguments),
    /// Make a self-signed certificate and its key to try TLS: cert.pem and key.pem
    #[command(after_help = "Examples:\n  \
        palpate certificate\n  \
        palpate certificate server.example 192.0.2.7 --days 30\n\n\
        The certificate is self-signed: clients trust it by --ca cert.pem. In production, use a certificate of your \
        own authority; docs/security.md has a recipe with openssl. Only the owner can read key.pem.\n\n\
        Exit status: 0; 1 when a file can't be written; 2 when an input was refused, or a file exists already.")]
    Certificate(certificate::CertificateArguments),
    /// Show the sessions of a server once a second (`palpate-client top`)
    #[command(disable_help_flag = true)]
    Top {
        /// See `palpate-client top --help`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<std::ffi::OsString>,
    },
    /// Show the resources that each caller uses on a server, and release them (`palpate-client admin`)
    #[command(disable_help_flag = true, disable_help_subcommand = true)]
    Admin {
        /// See `palpate-client admin --help`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<std::ffi::OsString>,
    },
    /// Show the servers and sessions of a fleet, and move sessions between servers (`palpate-client cluster`)
    #[command(disable_help_flag = true, disable_help_subcommand = true)]
    Cluster {
        /// See `palpate-client cluster --help`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<std::ffi::OsString>,
    },
}

fn main() -> ExitCode {
    let ended = match palpate_arguments::parse::<ServerArguments>().command {
        ServerCommand::Run(arguments) => within_memory(|| run::run_script(&arguments)),
        ServerCommand::Check(arguments) => within_memory(|| check::check(&arguments)),
        ServerCommand::Fit(arguments) => within_memory(|| fit::fit_curves(&arguments)),
        ServerCommand::Render(arguments) => within_memory(|| render::render(&arguments)),
        ServerCommand::Texture(arguments) => within_memory(|| texture::make_texture(&arguments)),
        ServerCommand::Mesh(arguments) => within_memory(|| mesh::mesh(&arguments)),
        ServerCommand::Organ(arguments) => within_memory(|| organ::organ(&arguments)),
        ServerCommand::Serve(arguments) => serve::serve(&arguments),
        #[cfg(windows)]
        ServerCommand::Service(arguments) => service::service(arguments),
        ServerCommand::Journal(arguments) => within_memory(|| journal::journal(&arguments)),
        ServerCommand::Token(arguments) => token::token(&arguments),
        ServerCommand::Certificate(arguments) => certificate::certificate(&arguments),
        ServerCommand::Top { arguments } => client::client("top", &arguments),
        ServerCommand::Admin { arguments } => client::client("admin", &arguments),
        ServerCommand::Cluster { arguments } => client::client("cluster", &arguments),
    };
    let (status, message) = match ended {
        Ok(()) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (1, message),
        Err(Failure::Refused(message)) => (2, message),
        Err(Failure::Told(status)) => return ExitCode::from(status),
    };
    say!("palpate: {message}");
    ExitCode::from(status)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    /// What is wider than `width` columns, other than single words and the names of options.
    fn too_wide(width: usize) -> Vec<String> {
        let mut found = Vec::new();
        for subcommand in super::ServerArguments::command().get_subcommands() {
            let help = subcommand.clone().term_width(width).render_long_help().to_string();
            // clap does not wrap the line of usage.
            let kept = |line: &str| line.starts_with("Usage:") || line.trim().starts_with('-');
            let is_one = |line: &str| !line.trim().contains(' ') || kept(line);
            let lines = help.lines().filter(|line| line.chars().count() > width && !is_one(line));
            found.extend(lines.map(|line| format!("{}: {line}", subcommand.get_name())));
        }
        found
    }

    #[test]
    fn help_fits_into_a_terminal_of_any_width() {
        super::ServerArguments::command().debug_assert();
        for width in [40, 80, 100, 160] {
            assert_eq!(too_wide(width), [""; 0], "{width} columns");
        }
    }

    #[test]
    fn paragraphs_of_help_are_wrapped_by_the_terminal_alone() {
        for subcommand in super::ServerArguments::command().get_subcommands() {
            let text = subcommand.get_after_help().map(ToString::to_string).unwrap_or_default();
            let lines: Vec<&str> = text.lines().collect();
            for pair in lines.windows(2) {
                let is_text = |line: &str| !line.is_empty() && !line.starts_with(' ');
                assert!(!(is_text(pair[0]) && is_text(pair[1])), "{}: {pair:?}", subcommand.get_name());
            }
        }
    }
}
