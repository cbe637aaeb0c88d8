//! Authentication and authorization: roles, the role that each call requires, and the token file, which gives roles
//! to tokens and client certificates.
//!
//! A server that authenticates refuses calls of its own package that are not in the table [`CALLS`]; a test checks
//! the table against the protocol's descriptors, so no call can be forgotten. Ids of sessions and leases are 128
//! random bits each: a caller with the role `touch` still needs the one to find a session and the other to command a
//! tool. A server without credentials on loopback refuses pages whose origin is a host name other than `localhost`:
//! such a name may resolve to this machine.

use std::path::Path;
use std::sync::Arc;

use http::HeaderValue;
use ring::digest::{SHA256, digest};
use serde::Deserialize;
use subtle::ConstantTimeEq;

use palpate_realtime::ids::random_bits;
use palpate_refusal::{Reason, Refusal, Result, label};
use palpate_tissue::scene::toml_document::nearest_name;

/// A role: what a caller may do. Every role includes `Watch`, and `Administer` includes every role but `Node`;
/// otherwise none includes another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Read from sessions whose ID the caller knows.
    Watch,
    /// Lease a tool and move it, change the tissue.
    Touch,
    /// Create, start, pause and delete sessions, upload meshes and journals, delete journals.
    Create,
    /// List all sessions of the server, and everything else except the calls between servers.
    Administer,
    /// A server of the same fleet: create sessions for its own callers, replicate journals, hand sessions over.
    Node,
}

impl Role {
    /// All roles, in the order of their declaration.
    pub const ALL: [Role; 5] = [Role::Watch, Role::Touch, Role::Create, Role::Administer, Role::Node];

    /// Returns the role's name in files and on the command line: that of the variant, in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Role::Watch => "watch",
            Role::Touch => "touch",
            Role::Create => "create",
            Role::Administer => "administer",
            Role::Node => "node",
        }
    }

    /// Returns the role with that name, in lower case.
    ///
    /// # Errors
    /// Refuses any other name, with the field `role` and the names of all roles.
    pub fn named(name: &str) -> Result<Role> {
        Role::ALL.into_iter().find(|role| role.name() == name).ok_or_else(|| {
            let message = format!("must be one of watch, touch, create, administer, node, but is `{name}`");
            Refusal::new(Reason::WrongKind, "role", message)
        })
    }
}

/// What a call requires of its caller, on a server that authenticates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// No role: the call reveals nothing about sessions.
    Open,
    /// The caller must have this role.
    Role(Role),
}

/// The path of each call (`/PACKAGE.SERVICE/METHOD`, sorted) and what it requires. The server refuses calls of its own
/// protocol that are not in this table; `tests/server/identity.rs` checks the table against the protocol's descriptors.
pub const CALLS: &[(&str, Access)] = &[
    ("/grpc.health.v1.Health/Check", Access::Open),
    ("/grpc.health.v1.Health/Watch", Access::Open),
    ("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo", Access::Open),
    ("/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", Access::Open),
    ("/palpate.v1.AdminService/CutCaller", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/CutStream", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/DrainNode", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/FreeTool", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ListCallers", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ListFleetSessions", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ListNodes", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ListStreams", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/MoveSession", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ReviveSession", Access::Role(Role::Administer)),
    ("/palpate.v1.ExerciseService/AdviseTrainee", Access::Role(Role::Create)),
    ("/palpate.v1.ExerciseService/FinishExercise", Access::Role(Role::Touch)),
    ("/palpate.v1.ExerciseService/HideLump", Access::Role(Role::Create)),
    ("/palpate.v1.ExerciseService/ListExercises", Access::Role(Role::Watch)),
    ("/palpate.v1.ExerciseService/WatchExercise", Access::Role(Role::Watch)),
    ("/palpate.v1.HapticService/AcquireTool", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/OpenDatagrams", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/Probe", Access::Role(Role::Watch)),
    ("/palpate.v1.HapticService/ReleaseTool", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/SendCommands", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/Touch", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/WatchSamples", Access::Role(Role::Watch)),
    ("/palpate.v1.NodeService/CreateHere", Access::Role(Role::Node)),
    ("/palpate.v1.NodeService/Mirror", Access::Role(Role::Node)),
    ("/palpate.v1.NodeService/TakeSession", Access::Role(Role::Node)),
    ("/palpate.v1.SessionService/CompareCurves", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/CreateSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/DeleteJournal", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/DeleteSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/GetJournal", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/GetScript", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/GetSession", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/GetStateHash", Access::Role(Role::Watch)),
    // Reveals IDs, as ListSessions does.
    ("/palpate.v1.SessionService/ListJournals", Access::Role(Role::Administer)),
    ("/palpate.v1.SessionService/ListScenes", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/ListScripts", Access::Role(Role::Watch)),
    // Reveals the IDs of all sessions; a caller that knows an ID can use that session.
    ("/palpate.v1.SessionService/ListSessions", Access::Role(Role::Administer)),
    ("/palpate.v1.SessionService/LocateSession", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/PauseSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/SaveSnapshot", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/StartSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/UpdateTissue", Access::Role(Role::Touch)),
    ("/palpate.v1.SessionService/UploadJournal", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/UploadMesh", Access::Role(Role::Create)),
    ("/palpate.v1.ViewService/AcknowledgeFrames", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/GetBurns", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/GetMesh", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/GetTexture", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/GetTopology", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/GetWound", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/WatchFrames", Access::Role(Role::Watch)),
];

/// Returns what the call at `path`, such as `/palpate.v1.HapticService/Touch`, requires; `None` if it is not in
/// [`CALLS`].
pub fn access(path: &str) -> Option<Access> {
    CALLS.iter().find(|call| call.0 == path).map(|call| call.1)
}

/// An authenticated or anonymous caller with its roles, as the server knows it during a call.
#[derive(Debug, Clone)]
pub struct Caller {
    /// The caller's name, for logs and messages: that of its entry in the token file; without a token file, the first
    /// name of its certificate, or `anonymous` if nothing authenticates it.
    pub name: Arc<str>,
    roles: Vec<Role>,
}

impl Caller {
    /// Returns the caller of a server without authentication: it may do everything.
    fn unrestricted() -> Self {
        Caller { name: "anonymous".into(), roles: vec![Role::Administer, Role::Node] }
    }

    /// Returns the caller of a call that requires no role: it has none.
    pub(super) fn anonymous() -> Self {
        Caller { roles: Vec::new(), ..Caller::unrestricted() }
    }

    /// Checks that the caller has `role`. Every caller has [`Role::Watch`].
    ///
    /// # Errors
    /// Refuses (`ROLE_MISSING`) if the caller has neither the role nor, for roles other than [`Role::Node`],
    /// [`Role::Administer`].
    pub fn needs(&self, role: Role) -> Result<()> {
        let includes_it = self.roles.contains(&Role::Administer) && role != Role::Node;
        if role == Role::Watch || self.roles.contains(&role) || includes_it {
            return Ok(());
        }
        let message = format!("`{}` lacks the role `{}`, which this call requires", self.name, role.name());
        Err(Refusal::new(Reason::RoleMissing, "", message))
    }
}

/// Every token begins with this, so that people and programs recognize it.
const PREFIX: &str = "palpate_";

/// Creates a token: `palpate_` and 64 hexadecimal digits, 256 random bits.
///
/// # Errors
/// Returns an error if the system gives no random bits.
pub fn new_token() -> Result<String> {
    Ok(format!("{PREFIX}{:032x}{:032x}", random_bits()?, random_bits()?))
}

/// Checks the name of a token's owner, or of a certificate.
fn owner(field: &str, name: &str) -> Result<()> {
    if name.trim().is_empty() {
        return Err(Refusal::new(
            Reason::Missing,
            field,
            "is empty: logs, limits and `palpate-client admin` know a caller by it",
        ));
    }
    label(field, name)
}

/// Returns the entry of a token for the token file, in TOML: the owner's name, its roles and the token's SHA-256, not
/// the token. The roles are not checked: [`KnownCallers::parse`] refuses an entry without any.
///
/// # Errors
/// Refuses a name that is empty, longer than 128 bytes or has control characters.
pub fn entry(name: &str, roles: &[Role], token: &str) -> Result<String> {
    owner("name", name)?;
    let roles: Vec<_> = roles.iter().map(|role| format!("\"{}\"", role.name())).collect();
    let hash: String = hash(token).iter().map(|byte| format!("{byte:02x}")).collect();
    let name = toml::Value::from(name);
    Ok(format!("[[token]]\nname = {name}\nroles = [{}]\nsha256 = \"{hash}\"\n", roles.join(", ")))
}

/// Returns the hash of a token. Since a token has 256 random bits, the hash needs neither salt nor a slow function.
fn hash(token: &str) -> [u8; 32] {
    let mut bytes = [0; 32];
    bytes.copy_from_slice(digest(&SHA256, token.as_bytes()).as_ref());
    bytes
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenFileContent {
    #[serde(default)]
    token: Vec<TokenEntry>,
    #[serde(default)]
    certificate: Vec<CertificateEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenEntry {
    name: String,
    roles: Vec<Role>,
    sha256: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CertificateEntry {
    name: String,
    roles: Vec<Role>,
}

/// The callers that the server knows: its tokens and client certificates with their roles. A reload of the token file
/// replaces it.
pub struct KnownCallers {
    /// Authentication is disabled.
    open: bool,
    /// There is no token file: any valid client certificate gives all rights.
    any_certificate: bool,
    tokens: Vec<([u8; 32], Caller)>,
    certificates: Vec<(String, Caller)>,
}

impl KnownCallers {
    /// Returns the callers of a server whose authentication is disabled: every caller may do everything.
    pub fn open() -> Self {
        KnownCallers { open: true, any_certificate: false, tokens: Vec::new(), certificates: Vec::new() }
    }

    /// Returns the callers of a server without a token file, on which every caller with a valid client certificate
    /// may do everything, and others nothing that requires a role.
    pub fn certified() -> Self {
        KnownCallers { open: false, any_certificate: true, ..KnownCallers::open() }
    }

    /// Returns whether authentication is disabled.
    pub fn is_open(&self) -> bool {
        self.open
    }

    /// Parses `text`, the contents of the token file at `path`, which only appears in refusals.
    ///
    /// # Errors
    /// Refuses, with the line, a text that is not TOML or has an unknown key or role; and, with the entry, a name
    /// that is not valid ([`entry`]) or that another entry of the same kind has, an entry without a role, and a
    /// `sha256` that is not 64 hexadecimal digits or occurs twice. No message quotes a token.
    pub fn parse(path: &Path, text: &str) -> Result<Self> {
        let file: TokenFileContent = toml::from_str(text).map_err(|e| {
            let line = e.span().map_or(1, |span| text[..span.start].matches('\n').count() + 1);
            // TOML's message may quote a misplaced token; a token must not appear in a log.
            let message =
                if e.message().contains(PREFIX) { "unexpected value".to_owned() } else { nearest_name(e.message()) };
            let place = Some(format!("{}:{line}", path.display()));
            Refusal { place, ..Refusal::new(Reason::Unreadable, "", message) }
        })?;
        let caller = |field: &str, name: &str, is_taken: bool, roles: Vec<Role>| {
            let field_of_name = format!("{field}.name");
            owner(&field_of_name, name)?;
            if is_taken {
                let message =
                    format!("`{name}` is the name of another entry in this file: a caller is known by its name");
                return Err(Refusal::new(Reason::OutOfRange, field_of_name, message));
            }
            if roles.is_empty() {
                let why = "is empty: give at least one of watch, touch, create, administer";
                return Err(Refusal::new(Reason::Missing, format!("{field}.roles"), why));
            }
            Ok(Caller { name: name.into(), roles })
        };
        let mut known = KnownCallers { open: false, ..KnownCallers::open() };
        for (index, TokenEntry { name, roles, sha256 }) in file.token.into_iter().enumerate() {
            let field = format!("token[{index}]");
            let wrong = || {
                let message = "must be 64 hexadecimal digits, a token's SHA-256; `palpate token` writes such entries";
                Refusal::new(Reason::WrongKind, format!("{field}.sha256"), message)
            };
            let hash = from_hex(&sha256).ok_or_else(wrong)?;
            if known.tokens.iter().any(|token| token.0 == hash) {
                let message = "duplicates that of another token in this file";
                return Err(Refusal::new(Reason::OutOfRange, format!("{field}.sha256"), message));
            }
            let is_taken = known.tokens.iter().any(|token| *token.1.name == name);
            let caller = caller(&field, &name, is_taken, roles)?;
            known.tokens.push((hash, caller));
        }
        for (index, CertificateEntry { name, roles }) in file.certificate.into_iter().enumerate() {
            let is_taken = known.certificates.iter().any(|certificate| certificate.0 == name);
            let caller = caller(&format!("certificate[{index}]"), &name, is_taken, roles)?;
            known.certificates.push((name, caller));
        }
        Ok(known)
    }

    /// Authenticates a caller by the header `authorization` if there is one, otherwise by the names in its client
    /// certificate.
    pub(super) fn caller(&self, authorization: Option<&HeaderValue>, certificate: Option<&[String]>) -> Result<Caller> {
        if self.open {
            return Ok(Caller::unrestricted());
        }
        let unknown = |message: &str| Refusal::new(Reason::Unauthenticated, "authorization", message);
        if let Some(value) = authorization {
            let text = value.to_str().unwrap_or_default();
            let token = match text.split_once(' ') {
                Some((scheme, token)) if scheme.eq_ignore_ascii_case("bearer") => token.trim(),
                _ => return Err(unknown("must be `Bearer TOKEN`")),
            };
            let hash = hash(token);
            // Compares with all hashes, each in full: the time taken reveals nothing about them.
            let found = self
                .tokens
                .iter()
                .fold(None, |found, (known, caller)| if bool::from(known.ct_eq(&hash)) { Some(caller) } else { found });
            return found.cloned().ok_or_else(|| unknown("the server does not know this token"));
        }
        match certificate {
            Some(names) if self.any_certificate => {
                let name = names.first().map_or("unnamed certificate", String::as_str);
                Ok(Caller { name: name.into(), ..Caller::unrestricted() })
            }
            Some(names) => {
                let known = self.certificates.iter().find(|known| names.contains(&known.0));
                let message = "is missing, and the server has no roles for the client's certificate";
                known.map(|known| known.1.clone()).ok_or_else(|| unknown(message))
            }
            None => Err(unknown("is missing: send `Bearer TOKEN` with a token of this server")),
        }
    }
}

fn from_hex(text: &str) -> Option<[u8; 32]> {
    let digits = text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    let mut bytes = [0; 32];
    for (index, byte) in bytes.iter_mut().enumerate().filter(|_| digits) {
        *byte = u8::from_str_radix(&text[2 * index..2 * index + 2], 16).ok()?;
    }
    digits.then_some(bytes)
}

/// The credentials that a caller presented, and the role that its call needs.
#[derive(Clone)]
pub(super) struct PresentedCredentials {
    pub(super) authorization: Option<HeaderValue>,
    /// The names of the certificate.
    pub(super) certificate: Option<Arc<[String]>>,
    pub(super) role: Role,
}

impl PresentedCredentials {
    /// Returns the caller if the credentials are valid and give it the required role.
    pub(super) fn check(&self, credentials: &KnownCallers) -> Result<Caller> {
        let caller = credentials.caller(self.authorization.as_ref(), self.certificate.as_deref())?;
        caller.needs(self.role)?;
        Ok(caller)
    }
}
