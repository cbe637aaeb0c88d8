//! Values that scenes give by a name from a list.

use palpate_refusal::{Reason, Refusal, Result, did_you_mean, excerpt};

/// A value that a scene gives by a name from a list, such as an integrator.
pub trait Named: Sized + Copy + PartialEq + 'static {
    /// Every name and its value; each name and each value once.
    const NAMES: &'static [(&'static str, Self)];

    /// Returns the value of a name, which must match exactly; `field` is the key that a refusal gives.
    ///
    /// # Errors
    /// Refuses a name that is not in the list ([`Reason::WrongKind`]); the message lists the names.
    fn named(field: &str, name: &str) -> Result<Self> {
        Self::NAMES.iter().find(|entry| entry.0 == name).map(|entry| entry.1).ok_or_else(|| {
            let names: Vec<_> = Self::NAMES.iter().map(|entry| entry.0).collect();
            let meant = did_you_mean(name, names.iter().copied());
            let message = format!("must be one of {}, but is `{}`{meant}", names.join(", "), excerpt(name));
            Refusal::new(Reason::WrongKind, field, message)
        })
    }

    /// Returns the name of a value; empty for a value that is not in the list.
    fn name(self) -> &'static str {
        Self::NAMES.iter().find(|entry| entry.1 == self).map_or("", |entry| entry.0)
    }
}

/// Writes an enum whose values scenes give by names, and its [`Named::NAMES`], from one list.
macro_rules! named {
    ($(#[$of_enum:meta])* pub enum $Enum:ident { $($(#[$of_value:meta])* $Value:ident = $name:literal,)+ }) => {
        $(#[$of_enum])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum $Enum {
            $($(#[$of_value])* $Value,)+
        }

        impl Named for $Enum {
            const NAMES: &'static [(&'static str, Self)] = &[$(($name, $Enum::$Value)),+];
        }
    };
}

pub(super) use named;
